"""Writing an ONNX graph an operation at a time, in float64."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

OPSET, IR_VERSION = 17, 8
"""Old enough for every ONNX Runtime since 1.12."""

INT64 = 7
"""ONNX's number of the type int64, for `Cast`."""

Shape = tuple[int | str, ...]


class Graph:
    """Calling it adds an operation and returns the name of its result.

    Raises
    ------
    ImportError
        Without the extra ``onnx``.
    """

    def __init__(self) -> None:
        try:
            import onnx
            import onnx.helper
            import onnx.numpy_helper
        except ImportError as error:
            raise ImportError(
                "Exporting needs the extra 'onnx': pip install 'iflow-gym[onnx]'."
            ) from error
        self._onnx: Any = onnx
        self._nodes: list[Any] = []
        self._constants: dict[tuple[bytes, tuple[int, ...], str], Any] = {}
        self._n_names = 0

    def __call__(
        self,
        operation: str,
        *inputs: str | NDArray[Any],
        output: str | None = None,
        **attributes: Any,
    ) -> str:
        """Add an operation on named results and constants; return its result's name."""
        output = output or self._name()
        names = [v if isinstance(v, str) else self._constant(v) for v in inputs]
        self._nodes.append(self._onnx.helper.make_node(operation, names, [output], **attributes))
        return output

    def split(self, value: str, sizes: list[int]) -> list[str]:
        """Return the named parts of a value, of so many rows each."""
        if len(sizes) == 1:
            return [value]
        outputs = [self._name() for _ in sizes]
        inputs = [value, self._constant(np.array(sizes))]
        self._nodes.append(self._onnx.helper.make_node("Split", inputs, outputs, axis=0))
        return outputs

    def squared(self, matrices: str, times: str) -> str:
        """Return matrices (n, d, d), each squared so many times, (n, 1, 1), in a loop."""
        helper, kinds = self._onnx.helper, self._onnx.TensorProto
        most = self("Cast", self("ReduceMax", times, keepdims=0), to=kinds.INT64)
        names = [self._name() for _ in range(7)]
        count, go, before, number, again, product, after = names
        body = helper.make_graph(
            [
                helper.make_node("Cast", [count], [number], to=kinds.DOUBLE),
                helper.make_node("Less", [number, times], [again]),
                helper.make_node("MatMul", [before, before], [product]),
                helper.make_node("Where", [again, product, before], [after]),
                helper.make_node("Identity", [go], [go + "_on"]),
            ],
            "square",
            [
                helper.make_tensor_value_info(count, kinds.INT64, []),
                helper.make_tensor_value_info(go, kinds.BOOL, []),
                helper.make_tensor_value_info(before, kinds.DOUBLE, None),
            ],
            [
                helper.make_tensor_value_info(go + "_on", kinds.BOOL, []),
                helper.make_tensor_value_info(after, kinds.DOUBLE, None),
            ],
        )
        return self("Loop", most, self._constant(np.array(True)), matrices, body=body)

    def serialised(
        self,
        inputs: Mapping[str, Shape],
        outputs: Mapping[str, Shape],
        metadata: Mapping[str, str],
    ) -> bytes:
        """Return the checked model file with these float64 inputs and outputs."""
        helper, kind = self._onnx.helper, self._onnx.TensorProto.DOUBLE
        graph = helper.make_graph(
            self._nodes,
            "mean_dynamics",
            [helper.make_tensor_value_info(name, kind, shape) for name, shape in inputs.items()],
            [helper.make_tensor_value_info(name, kind, shape) for name, shape in outputs.items()],
            list(self._constants.values()),
        )
        opsets = [helper.make_opsetid("", OPSET)]
        model = helper.make_model(
            graph, producer_name="iflow-gym", opset_imports=opsets, ir_version=IR_VERSION
        )
        helper.set_model_props(model, dict(metadata))
        self._onnx.checker.check_model(model, full_check=True)
        content: bytes = model.SerializeToString()
        return content

    def _name(self) -> str:
        self._n_names += 1
        return f"v{self._n_names}"

    def _constant(self, value: NDArray[Any]) -> str:
        value = np.ascontiguousarray(value).reshape(np.shape(value))
        key = (value.tobytes(), value.shape, value.dtype.str)
        if key not in self._constants:
            self._constants[key] = self._onnx.numpy_helper.from_array(value, self._name())
        name: str = self._constants[key].name
        return name
