// A point cloud of bounded size: fitted to the view, rotated with the mouse or by touch, coloured by a field, with a
// scale bar, axes and a legend. A click on a point emits its position. Shared by the desk and by pages. On the desk,
// points come from /cloud as float32 (see `pack` in thinned_cloud.py); for larger clouds the points in view are fetched
// from /cloud/detail when the view is at rest. A page gives its own points (`source`), in the same form.
import { OrbitControls, THREE } from "nicegui-scene";

const COLUMNS = 7;
const REST_MS = 300;
// Turbo (Mikhailov 2019), polynomials of degree 5 for red, green, blue.
const TURBO = [
  [0.13572138, 4.6153926, -42.66032258, 132.13108234, -152.94239396, 59.28637943],
  [0.09140261, 2.19418839, 4.84296658, -14.18503333, 4.27729857, 2.82956604],
  [0.1066733, 12.64194608, -60.58204836, 110.36276771, -89.90310912, 27.34824973],
];
const turbo = (x) =>
  TURBO.map((p) => Math.min(1, Math.max(0, p.reduceRight((sum, factor) => sum * x + factor, 0))));

const limited = (share) => Math.min(1, Math.max(0, share));
// Between stops: places from 0 to 1, each with red, green, blue.
const between = (stops, x) => {
  const next = Math.max(1, stops.findIndex(([place]) => x <= place));
  const [[low, from], [high, to]] = [stops[next - 1], stops[next]];
  return from.map((c, k) => c + ((x - low) / (high - low)) * (to[k] - c));
};

export default {
  template: `
    <div class="cloud-view" tabindex="0" aria-label="point cloud; arrow keys turn it, plus and minus zoom, F fits it">
      <canvas></canvas>
      <canvas class="axes" width="90" height="90"></canvas>
      <div class="keys" v-show="count">
        <div class="legend"><span>{{ high }}</span><div class="ramp"></div><span>{{ low }}</span><b>{{ legend }}</b></div>
        <div class="scale"><div class="bar"></div><span></span></div>
      </div>
      <div class="empty" :data-said="problem" v-show="!count">{{ problem }}</div>
    </div>`,
  // `deviations` are the colours of that field on the desk. Of a page: `source` of the points, `stops` of the colours, `limits` and `unit` of the field, direction of the `eye`.
  props: {
    field: String, version: Number, marks: Array, fit: Number, closer: Boolean, stops: Array, limits: Array,
    deviations: Array,
    source: { type: Function, default: () => fetch("cloud") }, unit: { type: String, default: "mm" },
    eye: { type: Array, default: () => [-0.5, 0.35, -1] }, up: { type: Array, default: () => [1, 0, 0] },
  },
  data: () => ({ legend: "", low: "", high: "", count: 0, problem: "no points yet" }),
  mounted() {
    try {
      this.renderer = new THREE.WebGLRenderer({ canvas: this.$el.children[0], antialias: true });
    } catch {
      this.problem = "this browser draws no WebGL: the cloud cannot be shown";
      return;
    }
    // Colours are shown without conversion.
    this.renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
    this.renderer.setClearColor(new THREE.Color().setRGB(0.06, 0.08, 0.11));
    this.scene = new THREE.Scene();
    // Orthographic, so that the scale holds at every depth.
    this.camera = new THREE.OrthographicCamera(-100, 100, 100, -100, -1e5, 1e5);
    this.controls = new OrbitControls(this.camera, this.renderer.domElement);
    this.controls.addEventListener("change", () => { this.draw(); this.rest(); });
    this.controls.addEventListener("start", () => (this.touched = true));
    this.material = new THREE.PointsMaterial({ size: 2, sizeAttenuation: false, vertexColors: true });
    [this.whole, this.near] = [0, 1].map(() => {
      const geometry = new THREE.BufferGeometry();
      const points = new THREE.Points(geometry, this.material);
      points.frustumCulled = false;
      this.scene.add(points);
      return { geometry, table: new Float32Array(0), origin: [0, 0, 0], count: 0 };
    });
    this.marked = new THREE.Points(
      new THREE.BufferGeometry(),
      new THREE.PointsMaterial({ size: 11, sizeAttenuation: false, color: 0xffffff, depthTest: false }),
    );
    this.marked.frustumCulled = false;
    this.scene.add(this.marked);
    this.fitted = 0;
    this.resized = new ResizeObserver(() => this.resize());
    this.resized.observe(this.$el);
    let pressed = null;
    const canvas = this.renderer.domElement;
    canvas.addEventListener("pointerdown", (event) => (pressed = [event.clientX, event.clientY]));
    canvas.addEventListener("pointerup", (event) => {
      if (pressed && Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) < 4) this.pick(event);
      pressed = null;
    });
    this.$el.addEventListener("keydown", (event) => this.key(event));
    this.resize();
    this.load();
  },
  beforeUnmount() {
    clearTimeout(this.resting);
    this.resized?.disconnect();
    this.controls?.dispose();
    this.renderer?.dispose();
    this.renderer?.forceContextLoss();
  },
  watch: {
    version() { this.load(); },
    field() { this.colour(); },
    marks() { this.mark(); },
    fit() { this.fitAll(); },
    closer() { this.rest(); },
  },
  methods: {
    async load() {
      if (!this.renderer) return;
      // One request at a time; a newer version is fetched afterwards.
      if (this.loading) { this.again = true; return; }
      this.loading = true;
      try {
        await this.take(this.whole, await this.source());
        this.count = this.whole.count;
        this.clearNear();
        this.colour();
        // Fit the growing cloud until the user rotates or zooms.
        if (!this.touched && this.count > 1.2 * this.fitted) this.fitAll();
        this.draw();
        this.rest();
        this.$el.dataset.points = this.count;
      } finally {
        setTimeout(() => {
          this.loading = false;
          if (this.again) { this.again = false; this.load(); }
        }, 1000);
      }
    },
    async take(layer, answer) {
      layer.origin = answer.headers.get("X-Origin").split(",").map(Number);
      layer.table = new Float32Array(await answer.arrayBuffer());
      layer.count = layer.table.length / COLUMNS;
      const places = new Float32Array(3 * layer.count);
      for (let k = 0; k < layer.count; k++)
        for (let c = 0; c < 3; c++) places[3 * k + c] = layer.table[COLUMNS * k + c] + layer.origin[c];
      layer.geometry.setAttribute("position", new THREE.BufferAttribute(places, 3));
    },
    clearNear() {
      this.asked = null;
      Object.assign(this.near, { table: new Float32Array(0), count: 0 });
      this.near.geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(0), 3));
      this.near.geometry.setAttribute("color", new THREE.BufferAttribute(new Float32Array(0), 3));
      delete this.$el.dataset.detail;
    },
    rest() {
      clearTimeout(this.resting);
      this.resting = setTimeout(() => this.refine(), REST_MS);
    },
    async refine() {
      const box = this.closer ? this.seenBox() : null;
      if (box === null) {
        this.clearNear();
        this.draw();
        return;
      }
      const asked = (this.asked = box.map((value) => value.toFixed(4)).join());
      const answer = await fetch(`cloud/detail?box=${asked}`);
      // The view may have changed meanwhile.
      if (answer.status !== 200 || asked !== this.asked) return;
      await this.take(this.near, answer);
      if (this.asked === null) this.clearNear();
      if (asked !== this.asked) return;
      this.colour();
      this.$el.dataset.detail = this.near.count;
    },
    seenBox() {
      // Box about the points in view, slightly enlarged; null if most points are in view, so that detail adds nothing.
      const matrix = new THREE.Matrix4().multiplyMatrices(this.camera.projectionMatrix, this.camera.matrixWorldInverse);
      const point = new THREE.Vector3();
      const box = new THREE.Box3();
      let seen = 0;
      let ofWhole = 0;
      for (const layer of [this.whole, this.near]) {
        const place = layer.geometry.getAttribute("position");
        for (let k = 0; k < layer.count; k++) {
          const at = point.fromBufferAttribute(place, k).clone();
          point.applyMatrix4(matrix);
          if (Math.abs(point.x) <= 1 && Math.abs(point.y) <= 1) { box.expandByPoint(at); seen++; }
        }
        if (layer === this.whole) ofWhole = seen;
      }
      if (!seen || ofWhole > this.whole.count / 2) return null;
      const size = box.getSize(new THREE.Vector3()).length();
      box.expandByScalar((2 * size) / Math.sqrt(seen) + 1e-3);
      return [...box.min.toArray(), ...box.max.toArray()];
    },
    column() { return { depth: 2, intensity: 3, deviation: 4, random: 5, common: 6 }[this.field] ?? 2; },
    // Turbo without its darkest end, which is invisible on a dark background.
    shade(share) {
      const stops = this.stops ?? (this.field === "deviation" ? this.deviations : null);
      return stops ? between(stops, limited(share)) : turbo(0.05 + 0.95 * limited(share));
    },
    colour() {
      if (!this.renderer) return;
      const steps = Array.from({ length: 11 }, (_, k) => `rgb(${this.shade(k / 10).map((c) => 255 * c)})`);
      this.$el.querySelector(".ramp").style.background = `linear-gradient(to top, ${steps})`;
      const column = this.column();
      const values = [];
      const table = this.whole.table;
      for (let k = column; k < table.length; k += COLUMNS) if (!Number.isNaN(table[k])) values.push(table[k]);
      values.sort((a, b) => a - b);
      const offset = column < 3 ? this.whole.origin[column] : 0;
      let low = values[Math.floor(0.01 * (values.length - 1))] ?? 0;
      let high = values[Math.ceil(0.99 * (values.length - 1))] ?? 1;
      // The scale of deviations is symmetric about zero.
      if (this.field === "deviation") { high = Math.max(Math.abs(low), Math.abs(high)); low = -high; }
      if (this.limits) [low, high] = this.limits;
      const span = high - low || 1;
      for (const layer of [this.whole, this.near]) {
        const colours = new Float32Array(3 * layer.count).fill(0.4);
        const moved = column < 3 ? layer.origin[column] - offset : 0;
        for (let k = 0; k < layer.count; k++) {
          const value = layer.table[COLUMNS * k + column] + moved;
          if (!Number.isNaN(value)) colours.set(this.shade((value - low) / span), 3 * k);
        }
        layer.geometry.setAttribute("color", new THREE.BufferAttribute(colours, 3));
      }
      const unit = this.field === "intensity" ? "grey values" : this.unit;
      const digits = Math.max(0, 2 - Math.floor(Math.log10(span)));
      const text = (value) => (value + offset).toFixed(Math.min(digits, 6));
      this.legend = values.length ? `${this.field}, ${unit}` : `${this.field}: not known`;
      this.low = values.length ? text(low) : "";
      this.high = values.length ? text(high) : "";
      this.draw();
    },
    mark() {
      if (!this.renderer) return;
      const places = new Float32Array((this.marks ?? []).flat());
      this.marked.geometry.setAttribute("position", new THREE.BufferAttribute(places, 3));
      this.draw();
    },
    resize() {
      const { clientWidth: width, clientHeight: height } = this.$el;
      if (!width || !height) return;
      this.renderer.setPixelRatio(window.devicePixelRatio);
      this.renderer.setSize(width, height, false);
      this.aspect();
      this.draw();
    },
    aspect() {
      const half = this.camera.top;
      this.camera.right = (half * this.$el.clientWidth) / Math.max(this.$el.clientHeight, 1);
      this.camera.left = -this.camera.right;
      this.camera.updateProjectionMatrix();
    },
    fitAll() {
      if (!this.count) return;
      this.fitted = this.count;
      this.whole.geometry.computeBoundingBox();
      const box = this.whole.geometry.boundingBox;
      const middle = box.getCenter(new THREE.Vector3());
      const radius = Math.max(box.getSize(new THREE.Vector3()).length() / 2, 1);
      // By default slightly from the side of the sensor's view: X up, Z away.
      this.camera.up.set(...this.up);
      this.camera.position.copy(middle).add(new THREE.Vector3(...this.eye).multiplyScalar(radius));
      this.controls.target.copy(middle);
      this.camera.zoom = 1;
      this.controls.update();
      this.camera.updateMatrixWorld();
      const wide = this.$el.clientWidth / Math.max(this.$el.clientHeight, 1);
      const corner = new THREE.Vector3();
      this.camera.top = 1e-3;
      for (let k = 0; k < 8; k++) {
        corner.set(...[0, 1, 2].map((c) => (((k >> c) & 1) ? box.max : box.min).getComponent(c)));
        corner.applyMatrix4(this.camera.matrixWorldInverse);
        this.camera.top = Math.max(this.camera.top, 1.1 * Math.abs(corner.y), (1.1 * Math.abs(corner.x)) / wide);
      }
      this.camera.bottom = -this.camera.top;
      this.camera.near = -10 * radius;
      this.camera.far = 10 * radius;
      this.aspect();
      this.draw();
    },
    draw() {
      if (!this.renderer) return;
      // Points nearly touch, so that they look like a surface, also in a closer view.
      const each = (0.5 * this.$el.clientWidth * this.$el.clientHeight) / (this.near.count || this.count || 1);
      this.material.size = Math.min(10, Math.max(2, Math.sqrt(each) * (this.near.count ? 1 : this.camera.zoom)));
      this.renderer.render(this.scene, this.camera);
      this.showScale();
      this.showAxes();
    },
    showScale() {
      const perPixel = (2 * this.camera.top) / this.camera.zoom / Math.max(this.$el.clientHeight, 1);
      // Beside the axes also on a phone.
      const wanted = Math.min(120, Math.max(30, this.$el.clientWidth - 115)) * perPixel;
      const ten = 10 ** Math.floor(Math.log10(wanted));
      const length = [5, 2, 1].map((n) => n * ten).find((n) => n <= wanted);
      const scale = this.$el.querySelector(".scale");
      scale.firstChild.style.width = `${length / perPixel}px`;
      scale.lastChild.textContent = `${Number(length.toPrecision(3))} mm`;
    },
    showAxes() {
      const pen = this.$el.querySelector(".axes").getContext("2d");
      pen.clearRect(0, 0, 90, 90);
      pen.font = "12px sans-serif";
      pen.lineWidth = 2;
      [["X", "#ff6b6b"], ["Y", "#69db7c"], ["Z", "#74c0fc"]].forEach(([name, colour], k) => {
        const way = new THREE.Vector3().setComponent(k, 1).transformDirection(this.camera.matrixWorldInverse);
        pen.strokeStyle = pen.fillStyle = colour;
        pen.beginPath();
        pen.moveTo(45, 45);
        pen.lineTo(45 + 30 * way.x, 45 - 30 * way.y);
        pen.stroke();
        pen.fillText(name, 41 + 39 * way.x, 49 - 39 * way.y);
      });
    },
    pick(event) {
      const box = this.renderer.domElement.getBoundingClientRect();
      const [u, v] = [event.clientX - box.left, event.clientY - box.top];
      const matrix = new THREE.Matrix4().multiplyMatrices(this.camera.projectionMatrix, this.camera.matrixWorldInverse);
      const point = new THREE.Vector3();
      let best = null;
      let nearest = Infinity;
      for (const layer of [this.whole, this.near]) {
        const place = layer.geometry.getAttribute("position");
        for (let k = 0; k < layer.count; k++) {
          point.fromBufferAttribute(place, k).applyMatrix4(matrix);
          const off = Math.hypot(((point.x + 1) / 2) * box.width - u, ((1 - point.y) / 2) * box.height - v);
          // Of the points under the finger, the one in front.
          if (off < 8 && point.z + off * 1e-3 < nearest) { nearest = point.z + off * 1e-3; best = [layer, k]; }
        }
      }
      if (best === null) return;
      const [layer, number] = best;
      const at = [0, 1, 2].map((c) => layer.table[COLUMNS * number + c] + layer.origin[c]);
      this.$emit("pick", { at, value: layer.table[COLUMNS * number + this.column()] });
    },
    key(event) {
      const turn = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
      if (turn) {
        const from = new THREE.Spherical();
        const offset = this.camera.position.clone().sub(this.controls.target);
        const turned = new THREE.Quaternion().setFromUnitVectors(this.camera.up, new THREE.Vector3(0, 1, 0));
        from.setFromVector3(offset.applyQuaternion(turned));
        from.theta += 0.1 * turn[0];
        from.phi = Math.min(Math.PI - 0.05, Math.max(0.05, from.phi + 0.1 * turn[1]));
        offset.setFromSpherical(from).applyQuaternion(turned.invert());
        this.camera.position.copy(this.controls.target).add(offset);
      } else if (event.key === "+" || event.key === "-") {
        this.camera.zoom *= event.key === "+" ? 1.2 : 1 / 1.2;
        this.camera.updateProjectionMatrix();
      } else if (event.key === "f" || event.key === "F") {
        this.touched = false;
        this.fitAll();
      } else return;
      event.preventDefault();
      if (event.key.length > 1 || "+-".includes(event.key)) this.touched = true;
      this.controls.update();
      this.draw();
      this.rest();
    },
  },
};
