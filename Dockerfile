# Demo, desk and notebooks on the CPU. docs/install.md shows how to use it.
FROM debian:bookworm-slim

# libaravis: GigE cameras; libatomic: the renderer's compiler; Chromium: reports as PDF.
RUN apt-get update \
    && apt-get install -y --no-install-recommends \
        python3 python3-venv libatomic1 libaravis-0.8-0 chromium-headless-shell fonts-dejavu-core \
    && rm -rf /var/lib/apt/lists/*

ENV PATH=/opt/venv/bin:$PATH
COPY pyproject.toml README.md LICENSE /opt/uwlts/
COPY uwlts /opt/uwlts/uwlts
COPY twin /opt/uwlts/twin
COPY scenes /opt/uwlts/scenes
RUN python3 -m venv /opt/venv \
    && pip install --no-cache-dir '/opt/uwlts[clouds,registration]' jupyterlab jupytext ipywidgets \
    # The wheel of LLVM finishes its installation at the first start of Python, and needs to write for that.
    && python -m twin.backend.llvm
COPY docs/tutorials /opt/uwlts/tutorials

RUN useradd --create-home diver && mkdir /work && chown diver /work
USER diver
WORKDIR /work
VOLUME /work

# The page, its laser-off process, and Jupyter.
EXPOSE 8080 8081 8888
CMD ["twin", "demo", "demo"]
