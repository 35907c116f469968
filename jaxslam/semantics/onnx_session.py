"""Run ONNX networks with onnxruntime on the CPU, with a limited number of threads."""

import ast
import os
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxslam.errors import ModelError
from jaxslam.semantics.class_names import stored_names
from jaxslam.semantics.onnx_signature import Graph, Port, image_input

FREE_SIZE = 416
"""Width and height in pixels for inputs of free size: a multiple of 32, and small enough for a CPU."""

_WARNINGS_OFF = 3  # errors and worse are logged

if TYPE_CHECKING:
    import onnxruntime

_DTYPES: dict[str, str] = {"float": "float32", "double": "float64"}


class Network:
    """An opened network.

    Attributes:
        path: File of the network.
        graph: Inputs and outputs of the network.
    """

    def __init__(self, path: Path, num_threads: int, free_size: int = FREE_SIZE) -> None:
        """Open a file. A network of one image runs once on a black image, because declared output sizes may be wrong.

        Args:
            path: ONNX file.
            num_threads: Number of threads of the network.
            free_size: Width and height in pixels of images for a network with inputs of free size.

        Raises:
            ModelError: If the file is missing or cannot be read, or the network does not run.
        """
        self.path = path
        self._session = _open(path, num_threads)
        self.graph = self._look(free_size)

    def run(self, tensor: np.ndarray) -> list[Any]:
        """Run the network on one input, and return all outputs: arrays, or other types that the graph declares.

        Raises:
            ModelError: If onnxruntime fails.
        """
        return self.feed({self._session.get_inputs()[0].name: tensor})

    def feed(self, inputs: Mapping[str, np.ndarray]) -> list[Any]:
        """Run the network on inputs by name, and return all outputs.

        Raises:
            ModelError: If onnxruntime fails.
        """
        try:
            return list(self._session.run(None, dict(inputs)))
        except _ort_errors() as error:
            raise ModelError(f"{self.path}: the network does not run: {_first_line(error)}") from error

    def _look(self, free_size: int) -> Graph:
        metadata = self._session.get_modelmeta().custom_metadata_map
        inputs, outputs = (
            tuple(map(_port, ports)) for ports in (self._session.get_inputs(), self._session.get_outputs())
        )
        image = image_input(inputs, _free_size(metadata, free_size))
        if image is not None:
            blank = np.zeros((image.height, image.width, 3), image.dtype)
            blank = blank.transpose(2, 0, 1) if image.channels_first else blank
            values = self.run(np.ascontiguousarray(blank[None] if image.batched else blank))
            outputs = tuple(_seen(port, value) for port, value in zip(outputs, values, strict=True))
        return Graph(image, inputs, outputs, stored_names(metadata))


def check_outputs(outputs: list[np.ndarray], ports: tuple[Port, ...], varying: bool) -> None:
    """Refuse outputs of the wrong shape, or with numbers that are not finite.

    Args:
        outputs: Outputs of the network.
        ports: Expected outputs.
        varying: Whether sizes, but not the number of axes, may differ between images.

    Raises:
        ModelError: If an output has another shape, or holds a number that is not finite.
    """
    for value, port in zip(outputs, ports, strict=True):
        fits = value.ndim == len(port.shape) if varying else value.shape == port.shape
        if not fits:
            raise ModelError(f"output {port.name}: expected shape {port.shape}, got {value.shape}")
        if port.is_float and value.size and not (np.isfinite(value.min()) and np.isfinite(value.max())):
            raise ModelError(f"output {port.name}: expected finite numbers, got {_count_bad(value)} that are not")


@cache
def _ort_errors() -> tuple[type[Exception], ...]:
    """Return the errors of onnxruntime, which have no common base class."""
    from onnxruntime.capi import (  # noqa: PLC0415
        onnxruntime_pybind11_state as state,  # pyright: ignore[reportAttributeAccessIssue]
    )

    own = (kind for kind in vars(state).values() if isinstance(kind, type) and issubclass(kind, Exception))
    return (*own, RuntimeError)


def _open(path: Path, num_threads: int) -> "onnxruntime.InferenceSession":
    if not path.is_file():
        raise ModelError(f"{path}: expected an ONNX file, got {'a folder' if path.is_dir() else 'nothing there'}")
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # read when it is imported, which else leaves files for that
    import onnxruntime  # noqa: PLC0415 - half as large as JAX, and only for runs with a network

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = num_threads, 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.log_severity_level = _WARNINGS_OFF
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # waiting must not cost a core
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except _ort_errors() as error:
        size = path.stat().st_size
        raise ModelError(
            f"{path}: expected an ONNX file, got {size} bytes that are none: {_first_line(error)}"
        ) from error


def _port(argument: Any) -> Port:
    """Convert an input or output of onnxruntime, which writes types as `tensor(float)`."""
    kind: str = argument.type
    if kind.startswith("tensor("):
        kind = kind[len("tensor(") : -1]
        kind = _DTYPES.get(kind, kind)
    shape = tuple(size if isinstance(size, int) and size > 0 else None for size in argument.shape or ())
    return Port(argument.name, shape, kind)


def _seen(port: Port, value: object) -> Port:
    return port._replace(shape=value.shape) if isinstance(value, np.ndarray) else port


def _free_size(metadata: dict[str, str], otherwise: int) -> int:
    """Return the image size in the network's metadata (Ultralytics' `imgsz`, [height, width]), or else the default."""
    try:
        sizes = ast.literal_eval(metadata.get("imgsz", ""))
    except (ValueError, SyntaxError):
        return otherwise
    largest = max(sizes, default=0) if isinstance(sizes, list | tuple) else sizes
    return largest if isinstance(largest, int) and largest > 0 else otherwise


def _count_bad(value: np.ndarray) -> str:
    return f"{np.count_nonzero(~np.isfinite(value))} of {value.size}"


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0]
