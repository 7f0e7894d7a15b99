"""An ONNX graph that is being written, by arithmetic on its values as if they were arrays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from onnx import ModelProto, TensorProto, helper, numpy_helper

OPSET, IR = 17, 8
END = 2**62  # Of an axis of any length.


def _binary(operator: str) -> tuple[Callable[[Value, Any], Value], Callable[[Value, Any], Value]]:
    return lambda x, y: x.graph(operator, x, y), lambda x, y: x.graph(operator, y, x)


class Value:
    """An input of the graph, or a node's output."""

    __array_ufunc__ = None  # array + value calls __radd__

    def __init__(self, graph: Graph, name: str) -> None:
        self.graph, self.name = graph, name

    __add__, __radd__ = _binary("Add")
    __sub__, __rsub__ = _binary("Sub")
    __mul__, __rmul__ = _binary("Mul")
    __truediv__, __rtruediv__ = _binary("Div")
    __matmul__, __rmatmul__ = _binary("MatMul")

    def reshape(self, *shape: int) -> Value:
        """0 keeps the size of an axis, -1 infers it."""
        return self.graph("Reshape", self, np.array(shape))

    def transpose(self, *axes: int) -> Value:
        return self.graph("Transpose", self, perm=axes)

    def slice(self, axis: int, start: int, end: int) -> Value:
        return self.graph("Slice", self, *(np.array([x]) for x in (start, end, axis)))

    def at(self, axis: int, index: int | Value) -> Value:
        """Selects an index of an axis, which is removed."""
        return self.graph("Gather", self, np.array(index) if isinstance(index, int) else index, axis=axis)

    def clip(self, low: float, high: float) -> Value:
        return self.graph("Clip", self, low, high)

    def double(self) -> Value:
        return self.graph("Cast", self, to=TensorProto.DOUBLE)

    def mean(self, *axes: int) -> Value:
        """The mean over these axes, which keep the size 1."""
        return self.graph("ReduceMean", self, axes=axes, keepdims=1)


class Graph:
    """`graph(operator, inputs…, attributes…)` adds a node. Numbers and arrays among the inputs become constants, of type
    float32, int64 or bool."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: dict[Any, Any] = {}
        self.inputs: list[Any] = []
        self.names = 0

    def new(self) -> Value:
        self.names += 1
        return Value(self, f"v{self.names}")

    def input(self, name: str, shape: tuple[int, ...]) -> Value:
        self.inputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", *shape]))
        return Value(self, name)

    def constant(self, given: Any) -> Value:
        array = np.asarray(given)
        array = array.astype({"i": np.int64, "b": np.bool_, "f": np.float32}[array.dtype.kind])
        key = (array.dtype, array.shape, array.tobytes())
        if key not in self.constants:
            self.constants[key] = numpy_helper.from_array(array, f"c{len(self.constants)}")
        return Value(self, self.constants[key].name)

    def __call__(self, operator: str, *inputs: Any, **attributes: Any) -> Value:
        names = [(x if isinstance(x, Value) else self.constant(x)).name for x in inputs]
        outs = [self.new() for _ in range(2 if operator == "TopK" else 1)]
        self.nodes.append(helper.make_node(operator, names, [out.name for out in outs], **attributes))
        return outs[0]

    def double(self, number: float) -> Value:
        """A float32 constant as float64."""
        return self("Cast", number, to=TensorProto.DOUBLE)

    def repeat(self, times: int, x: Value, body: Callable[[Value, Value], Value]) -> Value:
        """x = body(i, x) for i = 0, 1, … below `times`, as a loop of the graph."""
        outside, self.nodes = self.nodes, []
        index, condition, before = self.new(), self.new(), self.new()
        after, unchanged = body(index, before), self("Identity", condition)
        inside, self.nodes = self.nodes, outside

        def info(value: Value, kind: int, shape: list[int] | None) -> Any:
            return helper.make_tensor_value_info(value.name, kind, shape)

        given = [info(index, TensorProto.INT64, []), info(condition, TensorProto.BOOL, []), info(before, TensorProto.FLOAT, None)]
        left = [info(unchanged, TensorProto.BOOL, []), info(after, TensorProto.FLOAT, None)]
        return self("Loop", np.array(times), np.array(True), x, body=helper.make_graph(inside, "body", given, left))

    def model(self, outputs: dict[str, tuple[Value, tuple[int, ...]]], about: str, **metadata: object) -> ModelProto:
        """The model with these outputs, each with its shape after n, and its metadata."""
        for name, (value, _) in outputs.items():
            self.nodes.append(helper.make_node("Identity", [value.name], [name]))
        infos = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", *shape]) for name, (_, shape) in outputs.items()]
        graph = helper.make_graph(self.nodes, "policy", self.inputs, infos, list(self.constants.values()))
        opsets = [helper.make_opsetid("", OPSET)]
        made = helper.make_model(graph, opset_imports=opsets, ir_version=IR, producer_name="quad_rl", doc_string=about)
        helper.set_model_props(made, {name: str(value) for name, value in metadata.items()})
        return made
