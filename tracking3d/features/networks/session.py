"""A neural network in an ONNX file, run by onnxruntime on the CPU.

Only the ONNX graph is read: no code of a model file is executed, and nothing is unpickled.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from tracking3d.errors import InputError

LONGEST_RUN = 600.0
"""Seconds after which a run is ended; chosen. The largest encoders take a minute an image on a slow processor."""


class _Endless(Exception):
    """A network was still running after `LONGEST_RUN`."""


@dataclass(frozen=True)
class TensorInfo:
    """Description of one input or output of a network."""

    name: str
    shape: tuple[int | None, ...]  # None for a variable size
    dtype: str  # by NumPy's name


class Network:
    """An ONNX network ready to run, deterministically.

    Args:
        file: The ONNX file.
        threads: CPU threads of one run.

    Raises:
        InputError: The file does not exist, or is not an ONNX network that onnxruntime can run.
    """

    def __init__(self, file: Path, threads: int = 1) -> None:
        self.file = Path(file)
        if not self.file.is_file():
            raise InputError(f"The network {self.file} does not exist; give the path of an ONNX file.")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.log_severity_level = 4  # failures are raised and reported in one sentence
        # Waiting threads must not block the cores that the renderer needs.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            self._session = onnxruntime.InferenceSession(
                str(self.file), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # onnxruntime's exceptions have no common base of their own
            raise InputError(
                f"{self.file} is not a network that onnxruntime can run ({_describe_error(error)}); give an ONNX file."
            ) from error
        # By name, in the network's order.
        self.inputs = {node.name: _info(node) for node in self._session.get_inputs()}
        self.outputs = {node.name: _info(node) for node in self._session.get_outputs()}

    def run(self, feeds: Mapping[str, NDArray]) -> dict[str, NDArray]:
        """Run the network once.

        Args:
            feeds: An array for each input, by name.

        Returns:
            Every output by name.

        Raises:
            InputError: The network does not accept these arrays, answers with what is no number, or does not end.
        """
        try:
            results = self._run(dict(feeds))
        except _Endless as error:
            raise InputError(
                f"{self.file} did not end within {LONGEST_RUN:g} s; give another network."
            ) from error
        except Exception as error:
            shapes = ", ".join(f"{name} {np.shape(value)}" for name, value in feeds.items())
            raise InputError(f"{self.file} cannot be run on {shapes}: {_describe_error(error)}.") from error
        for name, values in zip(self.outputs, results, strict=True):
            if np.isnan(values).any():
                raise InputError(
                    f"The output '{name}' of {self.file} is not a number (NaN); correct how its description changes "
                    "an image's values, or export the network again."
                )
        return dict(zip(self.outputs, results, strict=True))

    def _run(self, feeds: dict[str, NDArray]) -> list[NDArray]:
        """Run it in another thread: this one hears Ctrl-C and SIGTERM meanwhile, and ends the run then."""
        options, outcome = onnxruntime.RunOptions(), Future[list[NDArray]]()

        def run() -> None:
            try:
                outcome.set_result(self._session.run(list(self.outputs), feeds, options))
            except Exception as error:
                outcome.set_exception(error)

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        try:
            return outcome.result(LONGEST_RUN)
        except BaseException as error:
            running, options.terminate = not outcome.done(), True
            thread.join()
            if running and isinstance(error, TimeoutError):
                raise _Endless from error
            raise


def _info(node: onnxruntime.NodeArg) -> TensorInfo:
    shape = tuple(size if isinstance(size, int) else None for size in node.shape)
    kind = node.type.removeprefix("tensor(").removesuffix(")")
    return TensorInfo(node.name, shape, {"float": "float32", "double": "float64"}.get(kind, kind))


def _describe_error(error: Exception) -> str:
    """The first line of an onnxruntime error, without its error codes."""
    text = " ".join(str(error).split()).rpartition(" : ")[2].rstrip(".")
    return text if len(text) <= 200 else text[:197] + "..."
