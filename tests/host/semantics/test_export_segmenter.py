"""Files that `docs/export_segmenter.py` writes give the masks of their models; needs PyTorch and transformers."""

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from jaxslam.semantics.network_check import check_segmenter, drawn_shapes
from jaxslam.semantics.onnx_session import Network
from jaxslam.semantics.prompted import load_segmenter, prompt
from jaxslam.semantics.prompted.in_context import is_in_context

torch: Any = pytest.importorskip("torch", reason="PyTorch is not installed")
transformers: Any = pytest.importorskip("transformers", reason="transformers is not installed")

ROOT = Path(__file__).resolve().parents[3]
SIDE, CHANNELS = 128, 32


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("export_segmenter", ROOT / "docs" / "export_segmenter.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def tiny_sam() -> Any:
    """A SAM of two layers that has learned nothing, with weights large enough to tell masks apart."""
    torch.manual_seed(0)
    vision = {"hidden_size": 32, "output_channels": CHANNELS, "num_hidden_layers": 2, "num_attention_heads": 2}
    vision |= {"image_size": SIDE, "mlp_dim": 32, "window_size": 4, "global_attn_indexes": [1], "num_pos_feats": 16}
    prompts = {"hidden_size": CHANNELS, "image_size": SIDE}
    masks = {"hidden_size": CHANNELS, "mlp_dim": 32, "num_attention_heads": 2, "iou_head_hidden_dim": 32}
    config = transformers.SamConfig(vision_config=vision, prompt_encoder_config=prompts, mask_decoder_config=masks)
    model = transformers.SamModel._from_config(config, attn_implementation="eager")
    with torch.no_grad():
        for parameter in model.mask_decoder.parameters():
            parameter.mul_(4)
    return model.eval()


@pytest.mark.filterwarnings("ignore")
def test_sam(script: ModuleType, tmp_path: Path) -> None:
    model = tiny_sam()
    segmenter = load_segmenter(*script.export_sam(model, tmp_path / "tiny"))
    assert segmenter.adapter == "sam"
    assert segmenter.at_once > 1
    picture, _ = drawn_shapes()
    boxes = np.array([[60, 20, 260, 210], [380, 20, 580, 220]], float)
    on, beside = (150, 100), (300, 240)
    embedding = segmenter.embed(picture)
    scale = SIDE / 640
    with torch.no_grad():
        embeddings = torch.tensor(embedding.values["image_embeddings"])
        corners = torch.tensor(boxes[None] * scale - 0.5, dtype=torch.float32)
        of_boxes = model(image_embeddings=embeddings, input_boxes=corners)
        points = torch.tensor((np.array([[[on, beside]]]) + 0.5) * scale - 0.5, dtype=torch.float32)
        of_points = model(image_embeddings=embeddings, input_points=points, input_labels=torch.tensor([[[1, 0]]]))
    for prompts, expected in (
        ([prompt("a", box=box) for box in boxes], of_boxes),
        ([prompt("a", on=[on], beside=[beside])], of_points),
    ):
        planes = segmenter._decoded(embedding, prompts)
        logits = expected.pred_masks[0].numpy()
        np.testing.assert_allclose(planes.logits, logits, atol=1e-4 * np.abs(logits).max())
        np.testing.assert_allclose(planes.ious, expected.iou_scores[0].numpy(), atol=1e-4)
    assert not check_segmenter(segmenter).good


@pytest.mark.filterwarnings("ignore")
def test_seggpt(script: ModuleType, tmp_path: Path) -> None:
    torch.manual_seed(0)
    config = transformers.SegGptConfig(
        hidden_size=32,
        num_hidden_layers=2,
        num_attention_heads=2,
        image_size=[128, 64],
        mlp_dim=32,
        decoder_hidden_size=16,
        intermediate_hidden_state_indices=[0, 1],
        merge_index=0,
        pretrain_image_size=64,
    )
    model = transformers.SegGptForImageSegmentation(config).eval()
    (path,) = script.export_seggpt(model, tmp_path / "tiny")
    network = Network(path, 1)
    assert is_in_context(network.graph)
    names = ("pixel_values", "prompt_pixel_values", "prompt_masks")
    images = {
        name: np.random.default_rng(number).normal(size=(1, 3, 64, 64)).astype(np.float32)
        for number, name in enumerate(names)
    }
    with torch.no_grad():
        expected = model(**{name: torch.tensor(image) for name, image in images.items()}).pred_masks.numpy()
    np.testing.assert_allclose(network.feed(images)[0], expected, atol=1e-4 * np.abs(expected).max())
