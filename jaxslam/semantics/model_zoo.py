"""Public networks that the detector can run: where they come from, under which license, and where they lie here."""

import os
from dataclasses import dataclass
from pathlib import Path

import platformdirs

from jaxslam.errors import MissingModelError, ModelError, nearest

DEFAULT_MODEL = "yolox-nano"
_YOLOX = "https://github.com/Megvii-BaseDetection/YOLOX"
_NANODET = "https://github.com/RangiLyu/nanodet"
_FASTESTDET = "https://github.com/dog-qiuqiu/FastestDet"
_DEEPLAB = "https://github.com/tensorflow/models/blob/master/research/deeplab/g3doc/model_zoo.md"
_TFLITE = "https://github.com/google-coral/test_data"
_MOBILE_SAM = "https://huggingface.co/Acly/MobileSAM"
_EFFICIENT_SAM = "https://github.com/yformer/EfficientSAM"
_SLIM_SAM = "https://huggingface.co/Xenova/slimsam-77-uniform"
_SAM2 = "https://huggingface.co/SharpAI/sam2-hiera-tiny-onnx"
_ULTRALYTICS = "https://docs.ultralytics.com/modes/export"


@dataclass(frozen=True)
class KnownModel:
    """A public network.

    Attributes:
        name: What commands and settings call it.
        file: Name of its file here.
        license: Of the weights, as an SPDX identifier.
        page: Who made it.
        adapter: What reads its outputs.
        about: What it is.
        url: Where the file is published; `None` if it must be made.
        size_bytes: Of the published file, if known.
        sha256: Of the published file, if known.
        how: How to come by the file, where there is no `url`.
    """

    name: str
    file: str
    license: str
    page: str
    adapter: str
    about: str
    url: str | None = None
    size_bytes: int | None = None
    sha256: str | None = None
    how: str = ""


KNOWN_MODELS: dict[str, KnownModel] = {
    model.name: model
    for model in (
        # YOLOX and NanoDet publish no checksums: sizes and SHA-256 are those that several projects, independent of each
        # other, pin for these addresses. Other exports of the same weights have others, and work as well.
        KnownModel(
            name="yolox-nano",
            file="yolox_nano.onnx",
            url=f"{_YOLOX}/releases/download/0.1.1rc0/yolox_nano.onnx",
            size_bytes=3_659_407,
            sha256="c789161ed43c8269fcd4e67c67eeeb4e80c622da2eb296a20bc6007bd18a0b7d",
            license="Apache-2.0",
            page=_YOLOX,
            adapter="yolox",
            about="boxes of the 80 COCO classes, 416x416",
        ),
        KnownModel(
            name="yolox-tiny",
            file="yolox_tiny.onnx",
            url=f"{_YOLOX}/releases/download/0.1.1rc0/yolox_tiny.onnx",
            size_bytes=20_219_662,
            sha256="427cc366d34e27ff7a03e2899b5e3671425c262ea2291f88bb942bc1cc70b0f7",
            license="Apache-2.0",
            page=_YOLOX,
            adapter="yolox",
            about="boxes of the 80 COCO classes, 416x416; slower and better than nano",
        ),
        KnownModel(
            name="nanodet-plus-m",
            file="nanodet-plus-m_416.onnx",
            url=f"{_NANODET}/releases/download/v1.0.0-alpha-1/nanodet-plus-m_416.onnx",
            sha256="59d2f166088889c902f523bf08079391993491324f0d84847e3c4016a8f7cc3d",
            license="Apache-2.0",
            page=_NANODET,
            adapter="nanodet_plus",
            about="boxes of the 80 COCO classes, 416x416",
        ),
        KnownModel(
            name="nanodet-m",
            file="nanodet_m_320.onnx",
            license="Apache-2.0",
            page=_NANODET,
            adapter="nanodet",
            about="boxes of the 80 COCO classes, 320x320",
            how="export it with tools/export_onnx.py of NanoDet before 1.0, which gives six outputs",
        ),
        # Size and SHA-256 computed from a copy with the same Git blob as in that repository, d60f81fc.
        KnownModel(
            name="fastestdet",
            file="FastestDet.onnx",
            url="https://raw.githubusercontent.com/dog-qiuqiu/FastestDet/main/example/onnx-runtime/FastestDet.onnx",
            size_bytes=998_169,
            sha256="31cb14c017fce347cb4c846ec62fdf00d76bb3beecdf4be21e7116ac67feb880",
            license="BSD-3-Clause",
            page=_FASTESTDET,
            adapter="fastestdet",
            about="boxes of the 80 COCO classes, 352x352; the fastest, and the least accurate",
        ),
        *(
            KnownModel(
                name=name,
                file=file,
                license="Apache-2.0",
                page=_DEEPLAB,
                adapter="class_map",
                about=f"a map of the 21 PASCAL VOC classes, 513x513; MobileNetV2{width}",
                how=f"take {tflite} from {_TFLITE}; then python -m tf2onnx.convert --tflite {tflite} --output {file}",
            )
            for name, file, tflite, width in (
                ("deeplabv3", "deeplabv3_mobilenetv2_voc.onnx", "deeplabv3_mnv2_pascal_quant.tflite", ""),
                (
                    "deeplabv3-dm05",
                    "deeplabv3_mobilenetv2_dm05_voc.onnx",
                    "deeplabv3_mnv2_dm05_pascal_quant.tflite",
                    " at half width",
                ),
            )
        ),
        *(
            KnownModel(
                name=name,
                file=f"{name}.onnx",
                license="AGPL-3.0",
                page=_ULTRALYTICS,
                adapter="yolov8_seg" if name.endswith("-seg") else "yolov8",
                about=about,
                how=f"its weights are under AGPL-3.0; export it yourself: yolo export model={name}.pt format=onnx",
            )
            for name, about in (
                ("yolov8n", "boxes of the 80 COCO classes"),
                ("yolov8n-seg", "boxes and masks of the 80 COCO classes"),
                ("yolo11n", "boxes of the 80 COCO classes"),
                ("yolo11n-seg", "boxes and masks of the 80 COCO classes"),
            )
        ),
        # Promptable segmenters, in pairs. Sizes and SHA-256 are those that several projects, independent of each other,
        # pin for these files. The files themselves were never at hand here: the adapters were run on graphs with the
        # names and shapes that their exporters write. Files published under a name that says nothing ("encoder.onnx")
        # are kept under that of the entry.
        *(
            KnownModel(
                name=name,
                file=file,
                url=url,
                size_bytes=size_bytes,
                sha256=sha256,
                license="Apache-2.0",
                page=page,
                adapter=adapter,
                about=about,
            )
            for name, file, page, url, size_bytes, sha256, adapter, about in (
                (
                    "mobilesam-encoder",
                    "mobile_sam_image_encoder.onnx",
                    _MOBILE_SAM,
                    f"{_MOBILE_SAM}/resolve/0d3b403339b4674a82493d5e97964dd78089ddc8/mobile_sam_image_encoder.onnx",
                    28_157_093,
                    "580f5fb648ea1062c0aabc26217aed56921985f03f0cbbd852bba81d760cc749",
                    "sam",
                    "for semantics.prompt_encoder, with mobilesam-decoder",
                ),
                (
                    "mobilesam-decoder",
                    "sam_mask_decoder_multi.onnx",
                    _MOBILE_SAM,
                    f"{_MOBILE_SAM}/resolve/0d3b403339b4674a82493d5e97964dd78089ddc8/sam_mask_decoder_multi.onnx",
                    16_496_559,
                    "8976b90a87ba50a6a72217a5ff994f7d25ce16f2229fcc1ed259e1294c622ffe",
                    "sam",
                    "for semantics.prompt_decoder, with mobilesam-encoder",
                ),
                (
                    "efficientsam-encoder",
                    "efficient_sam_vitt_encoder.onnx",
                    _EFFICIENT_SAM,
                    "https://raw.githubusercontent.com/yformer/EfficientSAM/f13035d925a0de803e8f733f3239fa05b1fcf36f"
                    "/weights/efficient_sam_vitt_encoder.onnx",
                    24_799_761,
                    "84ed466ffcc5c1f8d08409bc34a23bb364ab2c15e402cb12d4335a42be0e0951",
                    "efficient_sam",
                    "for semantics.prompt_encoder, with efficientsam-decoder",
                ),
                (
                    "efficientsam-decoder",
                    "efficient_sam_vitt_decoder.onnx",
                    _EFFICIENT_SAM,
                    "https://raw.githubusercontent.com/yformer/EfficientSAM/f13035d925a0de803e8f733f3239fa05b1fcf36f"
                    "/weights/efficient_sam_vitt_decoder.onnx",
                    16_565_728,
                    "a62f8fa5ea080447c0689418d69e58f1e83e0b7adf9c142e2bd9bcc8045c0b11",
                    "efficient_sam",
                    "for semantics.prompt_decoder, with efficientsam-encoder",
                ),
                (
                    "slimsam-encoder",
                    "slimsam-encoder.onnx",
                    _SLIM_SAM,
                    f"{_SLIM_SAM}/resolve/5850ab45f587c112167512ffef949107115e26a0/onnx/vision_encoder.onnx",
                    23_276_014,
                    "9f8433273a6750b587779baa0cf5508111001bf7e7acfcf585d370139fd366d0",
                    "transformers_sam",
                    "for semantics.prompt_encoder, with slimsam-decoder; boxes are asked for by their middle",
                ),
                (
                    "slimsam-decoder",
                    "slimsam-decoder.onnx",
                    _SLIM_SAM,
                    f"{_SLIM_SAM}/resolve/5850ab45f587c112167512ffef949107115e26a0/onnx"
                    "/prompt_encoder_mask_decoder.onnx",
                    16_557_892,
                    "f4514391764fbd56e08e119060d874ecd7d52994bfb1968af159e12d4943b5bb",
                    "transformers_sam",
                    "for semantics.prompt_decoder, with slimsam-encoder",
                ),
                (
                    "sam2-tiny-encoder",
                    "sam2-tiny-encoder.onnx",
                    _SAM2,
                    f"{_SAM2}/resolve/main/encoder.onnx",
                    134_261_315,
                    "df265cb552475e1b3a6cb57c939e57c95ed849bfc2f985c06efab85d8bca6db9",
                    "sam2",
                    "for semantics.prompt_encoder, with sam2-tiny-decoder",
                ),
                (
                    "sam2-tiny-decoder",
                    "sam2-tiny-decoder.onnx",
                    _SAM2,
                    f"{_SAM2}/resolve/main/decoder.onnx",
                    20_639_854,
                    "63198f1f1e273d8f2f4a9d1baf926e53a01d78dc50e0674640e1513dc00d9927",
                    "sam2",
                    "for semantics.prompt_decoder, with sam2-tiny-encoder",
                ),
            )
        ),
        KnownModel(
            name="seggpt",
            file="seggpt.onnx",
            license="MIT",
            page="https://github.com/baaivision/Painter",
            adapter="in_context",
            about="what is like examples, 448x448; a ViT-L",
            how="export BAAI/seggpt-vit-large of transformers as jaxslam/semantics/prompted/in_context.py says",
        ),
    )
}
"""By name; the first is the default."""


def models_dir() -> Path:
    """Where downloads go: `models` in the user's cache folder for jaxslam."""
    return Path(platformdirs.user_cache_dir("jaxslam", appauthor=False)) / "models"


def is_known(name: str) -> bool:
    """Whether there is a known model of that name, be its file here or not."""
    return name in KNOWN_MODELS


def known_model(name: str) -> KnownModel:
    """The network of that name.

    Raises:
        ModelError: If there is none.
    """
    if not is_known(name):
        raise ModelError(f"expected the name of a known model, got '{name}'{nearest(name, KNOWN_MODELS)}")
    return KNOWN_MODELS[name]


def local_file(model: KnownModel) -> Path | None:
    """Its file in the folder that `JAXSLAM_MODELS` names, else in `models_dir()`, else `None`.

    Raises:
        ModelError: If `JAXSLAM_MODELS` is set to something that is no folder.
    """
    folders = [models_dir()]
    if chosen := os.environ.get("JAXSLAM_MODELS"):
        if not Path(chosen).is_dir():
            raise ModelError(f"JAXSLAM_MODELS: expected a folder, got '{chosen}'")
        folders.insert(0, Path(chosen))
    names = dict.fromkeys((model.file, f"{model.name}.onnx"))
    return next((path for folder in folders for name in names if (path := folder / name).is_file()), None)


def find_model(name_or_path: str | os.PathLike[str] = DEFAULT_MODEL) -> Path:
    """The file of a network.

    Args:
        name_or_path: A file, or the name of a known model: its file is looked for in the folder that `JAXSLAM_MODELS`
            names, then in the user's cache folder, under the name it is published with and as `NAME.onnx`.

    Raises:
        MissingModelError: If a known network is not on this machine; it says how to come by it.
        ModelError: If there is no such file, and no known network of that name.
    """
    text = os.fspath(name_or_path)
    if Path(text).is_file():
        return Path(text)
    if not is_known(text):
        hint = nearest(text, KNOWN_MODELS)
        raise ModelError(f"expected a model file or the name of a known model, got '{text}'{hint}")
    model = KNOWN_MODELS[text]
    found = local_file(model)
    if found is None:
        way = f"to download it: jaxslam models get {text}" if model.url else model.how
        raise MissingModelError(
            f"{text} is not on this machine; {way}. To place it by hand: {models_dir() / model.file}"
        )
    return found
