"""Tiny promptable segmenters with the inputs and outputs of real ones; what they draw follows from prompts and image.

An encoder gives the mean color of blocks, normalized as the real ones are. A decoder draws the box it is asked for, or
a disc around the point, in its own coordinates, but only where the image is light. Of the masks that it offers, the one
with the highest score is right, the others are wrong all over; on the right side of its input it is unsure.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.helper
import onnx.parser
from onnx import numpy_helper

SIDE = 128
"""Of the encoders' inputs, where real ones have 1024."""
RADIUS = 20.0
"""Of discs, in pixels of the encoder's input."""
SURE, UNSURE = 0.9, 0.4
EXAMPLE_SIDE = 56
"""Of the in-context segmenter's input, where SegGPT has 448."""
MEAN, STD = np.array([123.675, 116.28, 103.53]), np.array([58.395, 57.12, 57.375])
_KINDS = ("none", "beside", "on", "first", "second")
"""What SAM's numbers from -1 on say of points; the last two are corners of a box."""
_SCORES = {4: (0.1, 0.2, 1.0, 0.3), 3: (0.2, 1.0, 0.1)}


def build(path: Path, text: str, constants: Mapping[str, Any]) -> Path:
    """A graph of ONNX's own text format."""
    model = onnx.parser.parse_model(f'<ir_version: 9, opset_import: ["" : 17]> {text}')
    onnx.helper.set_model_props(model, {"imgsz": str(SIDE)})  # where real ones leave the size open, and mean 1024
    arrays = {name: np.asarray(value) for name, value in constants.items()}
    arrays = {name: value.astype(np.float32) if value.dtype == float else value for name, value in arrays.items()}
    model.graph.initializer.extend(numpy_helper.from_array(value, name) for name, value in arrays.items())
    onnx.save(model, path)
    return path


def sam(folder: Path, *, hwc: bool = False, many: bool = False, output: str = "low_res_masks", blind: bool = False):
    """SAM's and MobileSAM's: `hwc` is an encoder that normalizes and pads; `many` takes prompts at once.

    `output` is what holds the masks; if that is `low_res_masks`, `masks` are there too, and wrong. A `blind` one draws
    in the dark too.
    """
    encoder = folder / "sam_encoder.onnx"
    if hwc:
        text = """sam (float[h, w, 3] input_image) => (float[1, 3, 16, 16] image_embeddings) {
            centered = Sub(input_image, mean)
            scaled = Div(centered, std)
            first = Transpose <perm = [2, 0, 1]> (scaled)
            size = Shape(first)
            missing = Sub(whole, size)
            pads = Concat <axis = 0> (zeros, missing)
            padded = Pad(first, pads)
            batch = Unsqueeze(padded, zero)
            image_embeddings = AveragePool <kernel_shape = [8, 8], strides = [8, 8]> (batch)
        }"""
        constants = {"mean": MEAN, "std": STD, "whole": [3, SIDE, SIDE], "zeros": [0, 0, 0], "zero": [0]}
        build(encoder, text, constants)
    else:
        text = f"""sam (float[b, 3, {SIDE}, {SIDE}] x) => (float[b, 3, 16, 16] image_embeddings) {{
            image_embeddings = AveragePool <kernel_shape = [8, 8], strides = [8, 8]> (x)
        }}"""
        build(encoder, text, {})
    num = "k" if many else "1"
    low = 'wide = Resize <mode = "linear"> (logits, none, none, fine)' if output == "masks" else ""
    last = """
        scale = Div(side, longest)
        exact = Mul(orig_im_size, scale)
        rounded = Add(exact, half)
        inner = Cast <to = 7> (rounded)
        cropped = Slice(wide, zeros, inner, last)
        pixels = Cast <to = 7> (orig_im_size)
        shape = Shape(logits)
        lead = Slice(shape, zero, two)
        target = Concat <axis = 0> (lead, pixels)
        masks = Resize <mode = "linear"> (cropped, none, none, target)
    """
    wrong = """
        low_res_masks = Identity(logits)
        pixels = Cast <to = 7> (orig_im_size)
        target = Concat <axis = 0> (lead, pixels)
        masks = Expand(one, target)
    """
    outputs = f"float[{num}, 4, h, w] masks, float[{num}, 4] iou_predictions"
    outputs += "" if output == "masks" else f", float[{num}, 4, 64, 64] low_res_masks"
    text = f"""sam (float[1, 3, 16, 16] image_embeddings, float[{num}, n, 2] point_coords, float[{num}, n] point_labels,
        float[1, 1, 64, 64] mask_input, float[1] has_mask_input, float[2] orig_im_size) => ({outputs}) {{
        coordinates = Add(point_coords, half)
        kinds = Unsqueeze(point_labels, two)
        seen = Resize <mode = "nearest"> (image_embeddings, none, quadruple)
        {_drawn(blind)}
        {_checked("one")}
        given = ReduceSum(mask_input)
        asked = Add(given, has_mask_input)
        right = Sub(checked, asked)
        {_offered(4)}
        iou_predictions = Identity(scores)
        longest = ReduceMax <keepdims = 0> (orig_im_size)
        {low}
        {last if output == "masks" else wrong}
    }}"""
    constants = _constants(64, 4) | {"fine": [1, 4, SIDE, SIDE], "side": float(SIDE), "last": [2, 3], "lead": [1, 4]}
    if output == "masks":
        del constants["lead"]
    return encoder, build(folder / "sam_decoder.onnx", text, constants)


def sam2(folder: Path, *, size: bool = False):
    """SAM 2's as samexporter has it, or with `orig_im_size`, which masks then have."""
    text = f"""sam2 (float[1, 3, {SIDE}, {SIDE}] image) => (float[1, 3, 32, 32] high_res_feats_0,
        float[1, 3, 16, 16] high_res_feats_1, float[1, 3, 8, 8] image_embed) {{
        high_res_feats_0 = AveragePool <kernel_shape = [4, 4], strides = [4, 4]> (image)
        high_res_feats_1 = AveragePool <kernel_shape = [8, 8], strides = [8, 8]> (image)
        image_embed = AveragePool <kernel_shape = [16, 16], strides = [16, 16]> (image)
    }}"""
    encoder = build(folder / "sam2_encoder.onnx", text, {})
    more = ", int32[2] orig_im_size" if size else ""
    last = """
        pixels = Cast <to = 7> (orig_im_size)
        shape = Shape(logits)
        lead = Slice(shape, zero, two)
        target = Concat <axis = 0> (lead, pixels)
        masks = Resize <mode = "linear"> (logits, none, none, target)
    """
    text = f"""sam2 (float[1, 3, 8, 8] image_embed, float[1, 3, 32, 32] high_res_feats_0,
        float[1, 3, 16, 16] high_res_feats_1, float[k, n, 2] point_coords, float[k, n] point_labels,
        float[k, 1, 32, 32] mask_input, float[k] has_mask_input{more})
        => (float[k, 3, h, w] masks, float[k, 3] iou_predictions) {{
        coordinates = Add(point_coords, half)
        kinds = Unsqueeze(point_labels, two)
        wide = Resize <mode = "nearest"> (high_res_feats_1, none, double)
        coarse = Resize <mode = "nearest"> (image_embed, none, quadruple)
        both = Add(wide, coarse)
        seen = Add(both, high_res_feats_0)
        {_drawn()}
        {_checked("zero_rows")}
        empty = Mul(mask_input, has_mask_input)
        right = Add(checked, empty)
        {_offered(3)}
        iou_predictions = Identity(scores)
        {last if size else "masks = Identity(logits)"}
    }}"""
    return encoder, build(folder / "sam2_decoder.onnx", text, _constants(32, 3) | {"double": [1.0, 1.0, 2.0, 2.0]})


def efficient_sam(folder: Path, *, one: bool = False):
    """EfficientSAM's: images of any size, masks of theirs; `one` takes a prompt of two points at a time."""
    text = """esam (float[b, 3, h, w] batched_images) => (float[b, 3, 8, 8] image_embeddings) {
        resized = Resize <mode = "linear"> (batched_images, none, none, square)
        centered = Sub(resized, mean)
        normal = Div(centered, std)
        image_embeddings = AveragePool <kernel_shape = [16, 16], strides = [16, 16]> (normal)
    }"""
    mean, std = (values[:, None, None] / 255 for values in (MEAN, STD))
    constants = {"square": [1, 3, SIDE, SIDE], "none": np.zeros(0, np.float32), "mean": mean, "std": std}
    encoder = build(folder / "esam_encoder.onnx", text, constants)
    num, points = ("1", "2") if one else ("q", "p")
    text = f"""esam (float[b, 3, 8, 8] image_embeddings, float[1, {num}, {points}, 2] batched_point_coords,
        float[1, {num}, {points}] batched_point_labels, int64[2] orig_im_size)
        => (float[1, {num}, 3, h, w] output_masks, float[1, {num}, 3] iou_predictions,
            float[{num}, 3, 32, 32] low_res) {{
        real = Cast <to = 1> (orig_im_size)
        width_first = Gather(real, swapped)
        per = Div(side, width_first)
        squeezed = Squeeze(batched_point_coords, zero)
        stretched = Mul(squeezed, per)
        coordinates = Add(stretched, half)
        flat = Squeeze(batched_point_labels, zero)
        kinds = Unsqueeze(flat, two)
        seen = Resize <mode = "nearest"> (image_embeddings, none, quadruple)
        {_drawn()}
        {_checked("any_rows" if one else "zero_rows")}
        right = Identity(checked)
        {_offered(3)}
        low_res = Identity(logits)
        shape = Shape(logits)
        lead = Slice(shape, zero, two)
        target = Concat <axis = 0> (lead, orig_im_size)
        whole = Resize <mode = "linear"> (logits, none, none, target)
        output_masks = Unsqueeze(whole, zero)
        iou_predictions = Unsqueeze(scores, zero)
    }}"""
    return encoder, build(
        folder / "esam_decoder.onnx", text, _constants(32, 3) | {"side": float(SIDE), "swapped": [1, 0]}
    )


def transformers_sam(folder: Path):
    """SlimSAM's: points alone."""
    text = f"""hf (float[b, 3, {SIDE}, {SIDE}] pixel_values) => (float[b, 3, 16, 16] image_embeddings,
        float[b, 3, 16, 16] image_positional_embeddings) {{
        image_embeddings = AveragePool <kernel_shape = [8, 8], strides = [8, 8]> (pixel_values)
        image_positional_embeddings = Mul(image_embeddings, nothing)
    }}"""
    encoder = build(folder / "vision_encoder.onnx", text, {"nothing": 0.0})
    text = f"""hf (float[b, q, n, 2] input_points, int64[b, q, n] input_labels, float[b, 3, 16, 16] image_embeddings,
        float[b, 3, 16, 16] image_positional_embeddings)
        => (float[b, q, 3] iou_scores, float[b, q, 3, 64, 64] pred_masks) {{
        squeezed = Squeeze(input_points, zero)
        coordinates = Add(squeezed, half)
        flat = Squeeze(input_labels, zero)
        real = Cast <to = 1> (flat)
        kinds = Unsqueeze(real, two)
        both = Add(image_embeddings, image_positional_embeddings)
        seen = Resize <mode = "nearest"> (both, none, quadruple)
        {_drawn()}
        {_checked("any_rows")}
        right = Identity(checked)
        {_offered(3)}
        pred_masks = Unsqueeze(logits, zero)
        iou_scores = Unsqueeze(scores, zero)
    }}"""
    return encoder, build(folder / "prompt_encoder_mask_decoder.onnx", text, _constants(64, 3))


def in_context(path: Path, *, many: bool = True, side: int | None = EXAMPLE_SIDE) -> Path:
    """SegGPT's: paints what has the mean color of the masked part of the example; open sizes are `side=None`."""
    num, rows, tall = ("b" if many else "1"), side or "h", 2 * side if side else "tall"
    image = f"float[{num}, 3, {rows}, {rows}]"
    text = f"""seggpt ({image} pixel_values, {image} prompt_pixel_values, {image} prompt_masks)
        => (float[{num}, 3, {tall}, {rows}] pred_masks) {{
        scaled = Mul(prompt_masks, std)
        white = Add(scaled, mean)
        inside = Greater(white, half)
        mask = Cast <to = 1> (inside)
        area = ReduceSum <keepdims = 1> (mask, plane)
        colored = Mul(prompt_pixel_values, mask)
        total = ReduceSum <keepdims = 1> (colored, plane)
        color = Div(total, area)
        apart = Sub(pixel_values, color)
        size = Abs(apart)
        distance = ReduceSum <keepdims = 1> (size, channel)
        like = Less(distance, half)
        number = Cast <to = 1> (like)
        centered = Sub(number, mean)
        painted = Div(centered, std)
        pred_masks = Concat <axis = 2> (prompt_masks, painted)
    }}"""
    mean, std = (values[:, None, None] / 255 for values in (MEAN, STD))
    return build(path, text, {"mean": mean, "std": std, "half": 0.5, "plane": [2, 3], "channel": [1]})


def _drawn(blind: bool = False) -> str:
    """From `coordinates` (k, n, 2), `kinds` (k, n, 1) and `seen` to `drawn` (k, 1, h, w) and its center `middle`."""
    sums = "".join(
        f"""
        is_{name} = Equal(kinds, kind_{name})
        at_{name} = Cast <to = 1> (is_{name})
        parts_{name} = Mul(coordinates, at_{name})
        sum_{name} = ReduceSum <keepdims = 0> (parts_{name}, one_axis)
        num_{name} = ReduceSum <keepdims = 0> (at_{name}, one_axis)
        place_{name} = Unsqueeze(sum_{name}, plane)
        any_{name} = Greater(num_{name}, half)
        has_{name} = Unsqueeze(any_{name}, plane)
        """
        for name in _KINDS
    )
    return f"""
        {sums}
        past_first = Sub(grid, place_first)
        before_second = Sub(place_second, grid)
        inside = Min(past_first, before_second)
        box = ReduceMin <axes = [1], keepdims = 1> (inside)
        apart = Sub(grid, place_on)
        squared = Mul(apart, apart)
        summed = ReduceSum <keepdims = 1> (squared, one_axis)
        distance = Sqrt(summed)
        disc = Sub(radius, distance)
        shape_drawn = Where(has_first, box, disc)
        apart_beside = Sub(grid, place_beside)
        squared_beside = Mul(apart_beside, apart_beside)
        summed_beside = ReduceSum <keepdims = 1> (squared_beside, one_axis)
        distance_beside = Sqrt(summed_beside)
        hole = Sub(distance_beside, radius)
        with_hole = Min(shape_drawn, hole)
        pierced = Where(has_beside, with_hole, shape_drawn)
        light = ReduceMean <axes = [1], keepdims = 1> (seen)
        much = Mul(light, far)
        drawn = {"Identity(pierced)" if blind else "Min(pierced, much)"}
        corners = Add(sum_first, sum_second)
        center = Mul(corners, half)
        middle = Where(any_first, center, sum_on)
    """


def _checked(rows: str) -> str:
    """`checked`: as drawn if there are as many rows that are no points as there should be, else nothing at all."""
    expected = {
        "one": "rows = Add(num_none, num_first)\nas_expected = Equal(rows, one)",
        "zero_rows": "as_expected = Equal(num_none, nothing)",
        "any_rows": "as_expected = GreaterOrEqual(num_none, nothing)",
    }[rows]
    return f"""
        {expected}
        fits = Unsqueeze(as_expected, plane)
        checked = Where(fits, drawn, minus)
    """


def _offered(num: int) -> str:
    """From `right` to `logits` (k, m, h, w) and `scores` (k, m)."""
    best = int(np.argmax(_SCORES[num]))
    names = ", ".join("right" if place == best else "opposite" for place in range(num))
    return f"""
        opposite = Neg(right)
        logits = Concat <axis = 1> ({names})
        across = Gather <axis = 1> (middle, first_column)
        on_the_left = Less(across, half_way)
        share = Where(on_the_left, sure, unsure)
        scores = Mul(share, offered)
    """


def _constants(cells: int, num: int) -> dict[str, Any]:
    centers = (np.arange(cells) + 0.5) * SIDE / cells
    grid = np.stack(np.meshgrid(centers, centers))[None]
    kinds = {f"kind_{name}": float(kind) for kind, name in enumerate(_KINDS, start=-1)}
    return kinds | {
        "grid": grid,
        "radius": RADIUS,
        "half": 0.5,
        "half_way": SIDE / 2,
        "far": 10.0,
        "minus": -1.0,
        "nothing": 0.0,
        "one": 1.0,
        "none": np.zeros(0, np.float32),
        "quadruple": [1.0, 1.0, 4.0, 4.0],
        "sure": SURE,
        "unsure": UNSURE,
        "offered": np.array([_SCORES[num]], float),
        "first_column": [0],
        "one_axis": [1],
        "plane": [2, 3],
        "zero": [0],
        "zeros": [0, 0],
        "two": [2],
    }
