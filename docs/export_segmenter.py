r"""Export a segmenter of Hugging Face to the ONNX files that jaxslam reads: SAM and its kind, or SegGPT.

It needs PyTorch and transformers, which jaxslam does not, so give it an environment of its own:

    python -m venv export
    export/bin/pip install torch transformers onnx
    export/bin/python docs/export_segmenter.py facebook/sam-vit-base models
    .venv/bin/jaxslam models check none --prompt-encoder models/sam-vit-base-encoder.onnx \
        --prompt-decoder models/sam-vit-base-decoder.onnx

The first argument is the name of a model, or a folder that `save_pretrained` has written; the second one is the folder
for the files. Models of the type `sam` (`facebook/sam-vit-base`, `-large`, `-huge`, `nielsr/slimsam-77-uniform`) become
an encoder and a decoder, with the inputs and outputs that SAM's own exporter gives them, so that boxes and points are
prompts; those of `seggpt` (`BAAI/seggpt-vit-large`) become one file. The weights keep their license.

Tried with PyTorch 2.14 and transformers 5.24 on untrained models of either type: the masks of the files are those of
the models.
"""

import argparse
from pathlib import Path

import torch
from transformers import AutoConfig, SamModel, SegGptForImageSegmentation

_OPSET = 17
_COUNTED_KINDS = 4  # beside the thing, on it, and the two corners of a box


class Encoder(torch.nn.Module):
    """The image encoder of SAM: `image` (1x3xSxS, normalized) -> `image_embeddings`."""

    def __init__(self, sam: SamModel) -> None:
        """Take the encoder of a model."""
        super().__init__()
        self.vision = sam.vision_encoder

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Embed an image."""
        return self.vision(image)[0]


class Decoder(torch.nn.Module):
    """The prompt encoder and the mask decoder of SAM, for any number of prompts of as many points each.

    `image_embeddings`, `point_coords` (Kxnx2, pixels of the encoder's input), `point_labels` (Kxn; -1 no point, 0
    beside the thing, 1 on it, 2 and 3 corners of its box) -> `low_res_masks` (Kx3xhxw), `iou_predictions` (Kx3).
    """

    def __init__(self, sam: SamModel) -> None:
        """Take the prompt encoder and the mask decoder of a model."""
        super().__init__()
        self.prompts, self.masks = sam.prompt_encoder, sam.mask_decoder
        self.register_buffer("places", sam.get_image_wide_positional_embeddings())
        kinds = [self.prompts.not_a_point_embed, *self.prompts.point_embed]
        self.register_buffer("kinds", torch.cat([kind.weight for kind in kinds[: 1 + _COUNTED_KINDS]]))

    def forward(
        self, image_embeddings: torch.Tensor, point_coords: torch.Tensor, point_labels: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Make three masks for each prompt, and say how well each fits."""
        side = self.prompts.input_image_size
        where = self.prompts.shared_embedding((point_coords + 0.5)[None], (side, side))
        labels = point_labels.long()[None]
        is_point = (labels >= 0)[..., None].to(where.dtype)
        sparse = where * is_point + self.kinds[labels + 1]
        dense = self.prompts.no_mask_embed.weight.reshape(1, -1, 1, 1).expand_as(image_embeddings)
        masks, ious = self.masks(
            image_embeddings=image_embeddings,
            image_positional_embeddings=self.places,
            sparse_prompt_embeddings=sparse,
            dense_prompt_embeddings=dense,
            multimask_output=True,
        )[:2]
        return masks[0], ious[0]


def export_sam(sam: SamModel, stem: Path) -> list[Path]:
    """Write the encoder and the decoder of SAM; return their paths."""
    paths = [stem.with_name(f"{stem.name}-{part}.onnx") for part in ("encoder", "decoder")]
    side = sam.config.vision_config.image_size
    image = torch.zeros(1, 3, side, side)
    encoder = Encoder(sam).eval()
    _export(encoder, (image,), paths[0], ["image"], ["image_embeddings"], {})
    prompts = torch.zeros(2, 3, 2), torch.ones(2, 3)
    open_axes = {name: {0: "prompts", 1: "points"} for name in ("point_coords", "point_labels")}
    open_axes |= {name: {0: "prompts"} for name in ("low_res_masks", "iou_predictions")}
    with torch.no_grad():
        embeddings = encoder(image)
    names = ["image_embeddings", "point_coords", "point_labels"], ["low_res_masks", "iou_predictions"]
    _export(Decoder(sam).eval(), (embeddings, *prompts), paths[1], *names, open_axes)
    return paths


def export_seggpt(model: SegGptForImageSegmentation, stem: Path) -> list[Path]:
    """Write SegGPT, for one example at a time; return its path."""
    path = stem.with_name(f"{stem.name}.onnx")
    height, width = model.config.image_size
    images = tuple(torch.zeros(3, 1, 3, height // 2, width))
    _export(model.eval(), images, path, ["pixel_values", "prompt_pixel_values", "prompt_masks"], ["pred_masks"], {})
    return [path]


def _export(
    module: torch.nn.Module,
    inputs: tuple[torch.Tensor, ...],
    path: Path,
    names: list[str],
    outputs: list[str],
    open_axes: dict[str, dict[int, str]],
) -> None:
    torch.onnx.export(
        module,
        inputs,
        str(path),
        input_names=names,
        output_names=outputs,
        dynamic_axes=open_axes,
        opset_version=_OPSET,
        dynamo=False,
    )


def main() -> None:
    """Export the model that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", help="name on Hugging Face, or a folder")
    parser.add_argument("folder", type=Path, help="folder for the files")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    kind, stem = AutoConfig.from_pretrained(options.model).model_type, options.folder / Path(options.model).name
    if kind == "sam":
        paths = export_sam(SamModel.from_pretrained(options.model, attn_implementation="eager"), stem)
    elif kind == "seggpt":
        paths = export_seggpt(SegGptForImageSegmentation.from_pretrained(options.model), stem)
    else:
        parser.error(f"{options.model}: expected a model of type sam or seggpt, got {kind}")
    print("\n".join(map(str, paths)))


if __name__ == "__main__":
    main()
