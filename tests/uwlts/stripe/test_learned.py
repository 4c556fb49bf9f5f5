"""The method of a trained network, with a model of known results: the centroid of bright pixels."""

import re
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from uwlts.errors import CaptureError, DescriptionError, RangeError, SetupError
from uwlts.stripe import StripeOptions, StripeStatus, extract_stripe, learned

LINES, LENGTH = 300, 170
DARK, DOUBTFUL = slice(0, 20), slice(20, 40)


def centroid_model(path, *, name="lines"):
    """Build a model that returns the centroid of the pixels above a tenth of the full scale.

    Its probability is the sum of these pixels, so that faint lines are uncertain.
    """
    held = [
        numpy_helper.from_array(np.float32(0.1), "level"),
        numpy_helper.from_array(np.float32(1e-9), "tiny"),
        numpy_helper.from_array(np.array([1], np.int64), "axis"),
        numpy_helper.from_array(np.arange(176, dtype=np.float32), "place"),
    ]
    nodes = [
        helper.make_node("Relu", ["above"], ["light"]),
        helper.make_node("ReduceSum", ["light", "axis"], ["visible"], keepdims=0),
        helper.make_node("Mul", ["light", "place"], ["weighted"]),
        helper.make_node("ReduceSum", ["weighted", "axis"], ["moment"], keepdims=0),
        helper.make_node("Add", ["visible", "tiny"], ["mass"]),
        helper.make_node("Div", ["moment", "mass"], ["centre_px"]),
    ]
    nodes.insert(0, helper.make_node("Sub", [name, "level"], ["above"]))
    outputs = [helper.make_tensor_value_info(each, TensorProto.FLOAT, ["n"]) for each in ("centre_px", "visible")]
    given = helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", "p"])
    graph = helper.make_graph(nodes, "centroid", [given], outputs, held)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9), str(path))
    return path


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return centroid_model(tmp_path_factory.mktemp("model") / "centroid.onnx")


@pytest.fixture(scope="module")
def drawn():
    """Draw centres (L,) and an image whose first lines are dark and whose next ones are faint."""
    centre = 80 + 20 * np.sin(np.arange(LINES) / 40)
    height = np.full(LINES, 200.0)
    height[DARK], height[DOUBTFUL] = 0.0, 34.0
    light = height[:, None] * np.exp(-0.5 * ((np.arange(LENGTH) - centre[:, None]) / 1.5) ** 2)
    return centre, np.round(light + 2).astype(np.uint8)


@pytest.mark.parametrize("along", ["height", "width"])
def test_centres_and_what_is_visible_are_the_models(model, drawn, along):
    centre, image = drawn
    options = StripeOptions(method="learned", model=str(model), end_lines=0)
    found = extract_stripe(image if along == "height" else image.T.copy(), stripe_along=along, options=options)
    assert (found.status[DARK] == StripeStatus.NO_STRIPE).all()
    assert (found.status[DOUBTFUL] == StripeStatus.AMBIGUOUS).all()
    assert (found.status[40:] == StripeStatus.OK).all()
    np.testing.assert_allclose(found.centre_px[40:], centre[40:], atol=0.02)
    # Measured in the image, not by the model.
    np.testing.assert_allclose(found.amplitude[40:], 200, rtol=0.05)
    np.testing.assert_allclose(found.width_px[40:], 3.53, rtol=0.05)
    assert np.isnan(found.centre_px[:40]).all() and np.isnan(found.amplitude[:40]).all()


def test_ends_are_left_out_as_with_other_methods(model, drawn):
    _, image = drawn
    found = extract_stripe(image, stripe_along="height", options=StripeOptions(method="learned", model=str(model)))
    assert (found.status[40:42] == StripeStatus.END).all() and found.status[42] == StripeStatus.OK


def test_deeper_images_are_shares_of_their_full_scale(model, drawn):
    centre, image = drawn
    options = StripeOptions(method="learned", model=str(model), end_lines=0)
    found = extract_stripe(image.astype(np.uint16) * 16, stripe_along="height", options=options, saturation=4095)
    np.testing.assert_allclose(found.centre_px[40:], centre[40:], atol=0.02)


def test_a_place_where_nothing_stands_out_is_no_stripe(model):
    image = np.full((40, LENGTH), 100, np.uint8)
    options = StripeOptions(method="learned", model=str(model))
    assert not (extract_stripe(image, stripe_along="height", options=options).status == StripeStatus.OK).any()


@pytest.mark.parametrize(
    "settings", [{"method": "learned"}, {"model": "stripe.onnx"}, {"method": "learned", "model": 3}]
)
def test_method_and_model_go_together(settings):
    with pytest.raises(RangeError, match="needs, the ONNX file of a model"):
        StripeOptions(**settings)


def test_other_files_are_refused(tmp_path, drawn):
    _, image = drawn
    foreign, text = centroid_model(tmp_path / "foreign.onnx", name="photo"), tmp_path / "text.onnx"
    text.write_text("not a model")
    cases = (
        (foreign, DescriptionError, r"has the inputs \['photo'\]"),
        (text, DescriptionError, "cannot be read as an ONNX model"),
        (tmp_path / "absent.onnx", CaptureError, "absent.onnx"),
    )
    for path, error, message in cases:
        with pytest.raises(error, match=message):
            extract_stripe(image, stripe_along="height", options=StripeOptions(method="learned", model=str(path)))


def test_without_onnx_runtime_the_extra_is_named(tmp_path, drawn, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    path = centroid_model(tmp_path / "again.onnx")
    with pytest.raises(SetupError, match=r"-m pip install 'onnx>="):
        extract_stripe(drawn[1], stripe_along="height", options=StripeOptions(method="learned", model=str(path)))


def refused(path, drawn, words):
    with pytest.raises(DescriptionError, match=words):
        extract_stripe(drawn[1], stripe_along="height", options=StripeOptions(method="learned", model=str(path)))


def test_loops_and_unknown_operators_are_refused(tmp_path, drawn):
    """A loop of 2^62 passes would never end."""
    held = onnx.load(centroid_model(tmp_path / "loop.onnx"))
    flag = helper.make_tensor_value_info("go", TensorProto.BOOL, [])
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["on"])],
        "body",
        [helper.make_tensor_value_info("pass", TensorProto.INT64, []), flag],
        [helper.make_tensor_value_info("on", TensorProto.BOOL, [])],
    )
    held.graph.initializer.append(numpy_helper.from_array(np.int64(2**62), "passes"))
    held.graph.node.append(helper.make_node("Loop", ["passes", ""], [], body=body))
    onnx.save(held, tmp_path / "loop.onnx")
    refused(tmp_path / "loop.onnx", drawn, "has the operators 'Loop', which this program does not run")
    held.graph.node[-1].op_type, held.graph.node[-1].domain = "Relu", "com.example"
    onnx.save(held, tmp_path / "other.onnx")
    refused(tmp_path / "other.onnx", drawn, "has the operators 'Relu'")
    held.graph.node[-1].domain = ""
    onnx.save(held, tmp_path / "within.onnx")
    refused(tmp_path / "within.onnx", drawn, "has functions or subgraphs")


def test_data_in_other_files_are_refused(tmp_path, drawn):
    held = onnx.load(centroid_model(tmp_path / "a.onnx"))
    held.graph.initializer[3].data_location = TensorProto.EXTERNAL
    held.graph.initializer[3].external_data.add(key="location", value="../secret")
    held.graph.initializer[3].ClearField("raw_data")
    (tmp_path / "b.onnx").write_bytes(held.SerializeToString())
    refused(tmp_path / "b.onnx", drawn, "refers to data in other files")


def test_models_that_take_too_much_memory_are_refused(tmp_path, drawn):
    """Thirty doublings of the lines would take 2^30 times their memory."""
    held = onnx.load(centroid_model(tmp_path / "a.onnx"))
    names = ["light", *(f"twice{k}" for k in range(30))]
    held.graph.node.extend(
        helper.make_node("Concat", [before, before], [after], axis=0) for before, after in pairwise(names)
    )
    held.graph.node.append(helper.make_node("Identity", [names[-1]], ["large"]))
    held.graph.output.append(helper.make_tensor_value_info("large", TensorProto.FLOAT, ["m", "p"]))
    onnx.save(held, tmp_path / "b.onnx")
    refused(tmp_path / "b.onnx", drawn, "cannot be run by ONNX Runtime on 256 lines of 176 pixels with 2 GiB")


def test_garbage_is_refused(tmp_path, drawn):
    content = centroid_model(tmp_path / "a.onnx").read_bytes()
    for length in range(0, len(content), 97):
        (tmp_path / "b.onnx").write_bytes(content[:length])
        refused(tmp_path / "b.onnx", drawn, "b.onnx")


def test_the_documented_network_has_listed_operators():
    """The example is trained with a library that tests do not need; its source names each operator."""
    source = (Path(__file__).parents[3] / "docs/examples/learned_stripe/network.py").read_text(encoding="utf-8")
    used = set(re.findall(r'node\("([A-Z]\w+)"', source))
    assert {"Conv", "Softmax", "Range"} <= used <= set(learned._OPERATORS.split())
