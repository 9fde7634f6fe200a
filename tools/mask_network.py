"""Reference masks for `--mask-model`: tiny networks, a photo, and what ONNX's own reference evaluator makes of it.

usage: mask_network.py OUT        (needs onnx and numpy; OUT is tests/golden/mask_network)
OUT/NAME.onnx are networks, OUT/photo.png is 16 x 12 pixels, OUT/expected.json has the object's share of each pixel, times 255, for each network and
range of pixels. `two_inputs` and `four_channels` are to be refused.
"""
import json
import pathlib
import struct
import sys
import zlib

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from onnx.reference import ReferenceEvaluator

H, W = 12, 16
RANGES = {
    "imagenet": ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225]),
    "unit": ([0.0] * 3, [1.0] * 3),
    "centered": ([0.5] * 3, [1.0] * 3),
    "signed": ([0.5] * 3, [0.5] * 3),
}


def network(probabilities, channels=3, inputs=1):
    rng = np.random.default_rng(7)
    first = rng.normal(0, 0.4, (4, channels, 3, 3)).astype(np.float32)
    second = rng.normal(0, 0.8, (1, 4, 1, 1)).astype(np.float32)
    bias = np.array([0.1, -0.2, 0.3, 0.0], np.float32)
    nodes = [
        # Exporters write all attributes, and not every reader knows what missing ones mean.
        helper.make_node("Conv", ["photo", "first", "bias"], ["a"], pads=[1, 1, 1, 1], strides=[1, 1], dilations=[1, 1]),
        helper.make_node("Relu", ["a"], ["b"]),
        helper.make_node("Conv", ["b", "second"], ["c" if probabilities else "mask"], pads=[0, 0, 0, 0], strides=[1, 1], dilations=[1, 1]),
    ]
    if probabilities:
        nodes.append(helper.make_node("Sigmoid", ["c"], ["mask"]))
    value = lambda name, c: helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, c, H, W])
    given = [value("photo", channels)] + [value(f"other{i}", 3) for i in range(inputs - 1)]
    weights = [numpy_helper.from_array(v, n) for v, n in ((first, "first"), (second, "second"), (bias, "bias"))]
    graph = helper.make_graph(nodes, "mask", given, [value("mask", 1)], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.checker.check_model(model)
    return model


def png(path, image):
    rows = b"".join(b"\0" + row.tobytes() for row in image)
    chunk = lambda kind, data: struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    head = struct.pack(">IIBBBBB", image.shape[1], image.shape[0], 8, 2, 0, 0, 0)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows, 9)) + chunk(b"IEND", b""))


def main():
    out = pathlib.Path(sys.argv[1])
    out.mkdir(parents=True, exist_ok=True)
    y, x = np.mgrid[0:H, 0:W]
    photo = np.stack([255 * x / W, 255 * y / H, 127 + 100 * np.sin(0.4 * x + 0.2 * y)], -1).astype(np.uint8)
    png(out / "photo.png", photo)
    expected = {}
    for name, probabilities in (("probabilities", True), ("log_odds", False)):
        model = network(probabilities)
        onnx.save(model, out / f"{name}.onnx")
        for key, (mean, deviation) in RANGES.items():
            pixels = (photo / 255.0 - np.array(mean)) / np.array(deviation)
            given = pixels.transpose(2, 0, 1)[None].astype(np.float32)
            (mask,) = ReferenceEvaluator(model).run(None, {"photo": given})
            if not probabilities:
                assert mask.min() < 0 or mask.max() > 1
                mask = 1 / (1 + np.exp(-mask))
            expected[f"{name}-{key}"] = [round(255 * float(v), 1) for v in mask.ravel()]
    onnx.save(network(True, inputs=2), out / "two_inputs.onnx")
    onnx.save(network(True, channels=4), out / "four_channels.onnx")
    (out / "expected.json").write_text(json.dumps(expected))


main()
