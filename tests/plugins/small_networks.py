"""Small networks as ONNX files: a corner detector of convolutions, a matcher of nearest neighbours, and constant answers for the other slots."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper


def save(path: Path, nodes: list[Any], inputs: dict[str, list[Any]], outputs: dict[str, list[Any]], constants: dict[str, Any]) -> Path:
    """Write a network; lengths that are text are any."""
    described = [[helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in side.items()] for side in (inputs, outputs)]
    tensors = [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()]
    graph = helper.make_graph(nodes, path.stem, *described, tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save_model(model, path)
    return path


def corner_detector(path: Path, count: int = 300) -> Path:
    """Harris corners by convolutions: `image` (1, 1, h, w) to `keypoints` (1, n, 2), `scores` (1, n) and `descriptors` (1, n, 49), the samples of a
    patch about each without its mean."""
    sobel = np.array([[-1, 0, 1], [-2, 0, 2], [-1, 0, 1]], np.float32)
    samples = np.zeros((49, 1, 19, 19), np.float32)  # 7 × 7, 3 px apart
    for k in range(49):
        samples[k, 0, 3 * (k // 7), 3 * (k % 7)] = 1.0
    blur = np.full((1, 1, 5, 5), 1 / 25, np.float32)
    constants = {
        "sobel": np.stack([sobel, sobel.T])[:, None],
        "blur": blur,
        "k": np.float32(0.05),
        "one": np.array([1]),
        "count": np.array([count]),
        "flat": np.array([-1]),
        "samples": samples,
        "rows": np.array([49, -1]),
        "batch": np.array([0]),
        "third": np.array([3]),
    }
    node = helper.make_node
    nodes = [
        node("Conv", ["image", "blur"], ["smooth"], pads=[2] * 4),
        node("Conv", ["smooth", "sobel"], ["gradient"], pads=[1] * 4),
        node("Split", ["gradient"], ["gx", "gy"], axis=1),
        node("Mul", ["gx", "gx"], ["xx"]),
        node("Mul", ["gy", "gy"], ["yy"]),
        node("Mul", ["gx", "gy"], ["xy"]),
        node("Conv", ["xx", "blur"], ["a"], pads=[2] * 4),
        node("Conv", ["yy", "blur"], ["b"], pads=[2] * 4),
        node("Conv", ["xy", "blur"], ["c"], pads=[2] * 4),
        node("Mul", ["a", "b"], ["ab"]),
        node("Mul", ["c", "c"], ["cc"]),
        node("Sub", ["ab", "cc"], ["determinant"]),
        node("Add", ["a", "b"], ["trace"]),
        node("Mul", ["trace", "trace"], ["squared"]),
        node("Mul", ["squared", "k"], ["penalty"]),
        node("Sub", ["determinant", "penalty"], ["harris"]),
        node("MaxPool", ["harris"], ["largest"], kernel_shape=[9, 9], pads=[4] * 4, strides=[1, 1]),
        node("Equal", ["harris", "largest"], ["peak"]),
        node("Cast", ["peak"], ["peaks"], to=TensorProto.FLOAT),
        node("Mul", ["harris", "peaks"], ["response"]),
        node("Reshape", ["response", "flat"], ["line"]),
        node("TopK", ["line", "count"], ["best", "places"], axis=0),
        node("Shape", ["image"], ["shape"]),
        node("Gather", ["shape", "third"], ["width"], axis=0),
        node("Mod", ["places", "width"], ["x"]),
        node("Div", ["places", "width"], ["y"]),
        node("Unsqueeze", ["x", "one"], ["xs"]),
        node("Unsqueeze", ["y", "one"], ["ys"]),
        node("Concat", ["xs", "ys"], ["pixels"], axis=1),
        node("Cast", ["pixels"], ["numbers"], to=TensorProto.FLOAT),
        node("Unsqueeze", ["numbers", "batch"], ["keypoints"]),
        node("Unsqueeze", ["best", "batch"], ["scores"]),
        node("Conv", ["smooth", "samples"], ["patches"], pads=[9] * 4),
        node("Reshape", ["patches", "rows"], ["columns"]),
        node("Gather", ["columns", "places"], ["chosen"], axis=1),
        node("Transpose", ["chosen"], ["described"], perm=[1, 0]),
        node("ReduceMean", ["described"], ["mean"], axes=[1], keepdims=1),
        node("Sub", ["described", "mean"], ["centred"]),
        node("Unsqueeze", ["centred", "batch"], ["descriptors"]),
    ]
    inputs = {"image": [1, 1, "h", "w"]}
    outputs = {"keypoints": [1, count, 2], "scores": [1, count], "descriptors": [1, count, 49]}
    return save(path, nodes, inputs, outputs, constants)


def nearest_matcher(path: Path, least: float = 0.9) -> Path:
    """Mutual nearest neighbours by the cosine of descriptors: LightGlue's tensors."""
    node = helper.make_node
    nodes = [
        node("Transpose", ["desc1"], ["across"], perm=[0, 2, 1]),
        node("MatMul", ["desc0", "across"], ["cosines"]),
        node("ReduceMax", ["cosines"], ["best0"], axes=[2], keepdims=1),
        node("ReduceMax", ["cosines"], ["best1"], axes=[1], keepdims=1),
        node("Equal", ["cosines", "best0"], ["forth"]),
        node("Equal", ["cosines", "best1"], ["back"]),
        node("And", ["forth", "back"], ["mutual"]),
        node("Greater", ["cosines", "least"], ["near"]),
        node("And", ["mutual", "near"], ["matched"]),
        node("NonZero", ["matched"], ["places"]),
        node("Transpose", ["places"], ["rows"], perm=[1, 0]),
        node("GatherND", ["cosines", "rows"], ["mscores0"]),
        node("Slice", ["rows", "start", "end", "axis"], ["pairs"]),
        node("Cast", ["pairs"], ["matches0"], to=TensorProto.FLOAT),
    ]
    constants = {"least": np.float32(least), "start": np.array([1]), "end": np.array([3]), "axis": np.array([1])}
    inputs = {"kpts0": [1, "n", 2], "kpts1": [1, "m", 2], "desc0": [1, "n", 49], "desc1": [1, "m", 49]}
    return save(path, nodes, inputs, {"matches0": ["k", 2], "mscores0": ["k"]}, constants)


def answering(path: Path, channels: int, **answers: np.ndarray) -> Path:
    """A network of an image of any size that always gives these arrays; each is added to nothing of the image, so that it takes part."""
    node = helper.make_node
    nodes = [node("ReduceMean", ["image"], ["mean"], keepdims=0), node("Mul", ["mean", "zero"], ["nothing"])]
    nodes += [node("Add", [f"{name}_answer", "nothing"], [name]) for name in answers]
    constants = {"zero": np.float32(0), **{f"{name}_answer": np.asarray(value, np.float32) for name, value in answers.items()}}
    return save(path, nodes, {"image": [1, channels, "h", "w"]}, {name: list(value.shape) for name, value in answers.items()}, constants)


def network_words(slot: str, folder: Path) -> list[str]:
    """Overrides with which `SLOT=onnx` (or the like) runs on small networks that are written to a folder."""
    rng = np.random.default_rng(0)
    if slot == "keypoints":
        return [f"keypoints.model={corner_detector(folder / 'corners.onnx')}"]
    if slot == "tracks":
        keypoints = ["keypoints=onnx", *network_words("keypoints", folder)]
        return [*keypoints, f"tracks.model={nearest_matcher(folder / 'matcher.onnx')}"]
    if slot == "lines":
        lines = np.array([[[20, 30, 200, 40], [50, 200, 60, 60], [10, 10, 300, 12]]], np.float32)
        return [f"lines.model={answering(folder / 'lines.onnx', 1, lines=lines, scores=np.array([[0.9, 0.5, 0.8]]))}"]
    if slot == "planes":
        masks = np.zeros((1, 2, 60, 80), np.float32)
        masks[0, 0, 35:, :], masks[0, 1, :25, 40:] = 1.0, 1.0
        return [f"planes.model={answering(folder / 'masks.onnx', 3, masks=masks, scores=np.array([[0.9, 0.8]]))}"]
    if slot == "normals":
        normals = rng.normal(size=(1, 3, 30, 40)) + np.array([0.0, 0.0, -3.0])[None, :, None, None]
        return [f"normals.model={answering(folder / 'normals.onnx', 3, normals=normals)}"]
    if slot == "loop":
        return [f"loop.model={small_image(folder / 'places.onnx')}"]
    raise ValueError(slot)


def small_image(path: Path) -> Path:
    """A descriptor of an image of 12 × 16 pixels: the pixels of its mean channel without their mean."""
    node = helper.make_node
    nodes = [
        node("ReduceMean", ["image"], ["grey"], axes=[1], keepdims=0),
        node("Reshape", ["grey", "flat"], ["pixels"]),
        node("ReduceMean", ["pixels"], ["mean"], axes=[1], keepdims=1),
        node("Sub", ["pixels", "mean"], ["descriptor"]),
    ]
    return save(path, nodes, {"image": [1, 3, 12, 16]}, {"descriptor": [1, 192]}, {"flat": np.array([1, -1])})
