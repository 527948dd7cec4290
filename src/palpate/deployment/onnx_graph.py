"""A graph of ONNX, written node by node.

With `onnx.helper`: the networks here are a few dozen nodes. A converter from JAX would pin a dozen
packages for them and leave names and order to chance.
"""

from typing import Any

import numpy as np

from palpate.errors import extra_module
from palpate.networks import Channel

EXTRA = "deploy"
_OPSET, _IR = 17, 8  # read by every ONNX Runtime from 1.12 (2022) on


class Graph:
    """Nodes and constants in the order they were added, each result under a name of its own.

    Raises `PalpateError` without the extra `deploy`.
    """

    def __init__(self) -> None:
        onnx = extra_module("onnx", EXTRA)
        self._onnx = onnx
        self._nodes: list[Any] = []
        self._constants: list[Any] = []
        self._sum_axis = self.constant([-1], np.int64)

    def constant(self, value: Any, dtype: type = np.float32) -> str:
        """The name of an array of that value."""
        name = f"constant_{len(self._constants)}"
        array = np.ascontiguousarray(value, dtype).reshape(np.shape(value))
        self._constants.append(self._onnx.numpy_helper.from_array(array, name))
        return name

    def add(self, kind: str, *inputs: str, output: str = "", **attributes: Any) -> str:
        """The name of what a node of that kind makes of its inputs: `output`, or one of its own."""
        output = output or f"{kind.lower()}_{len(self._nodes)}"
        node = self._onnx.helper.make_node(kind, inputs, [output], **attributes)
        self._nodes.append(node)
        return output

    def square(self, vector: str) -> str:
        """The squared length along the last axis, which stays with size 1."""
        return self.add("ReduceSum", self.add("Mul", vector, vector), self._sum_axis, keepdims=1)

    def shortened(self, vector: str, limit: float) -> str:
        """The vector itself up to the length `limit`, else the one of that length beside it."""
        square = self.add("Max", self.square(vector), self.constant(limit**2))
        return self.add(
            "Mul", vector, self.add("Div", self.constant(limit), self.add("Sqrt", square))
        )

    def part(self, flat: str, first: int, channel: Channel) -> str:
        """The numbers of a channel from `first` on, in its shape."""
        places = [self.constant([place], np.int64) for place in (first, first + channel.count, 1)]
        own = self.add("Slice", flat, *places)
        return self.add("Reshape", own, self.constant([-1, *channel.shape], np.int64))

    def flat(self, value: str, count: int) -> str:
        """The value as rows of `count` numbers."""
        return self.add("Reshape", value, self.constant([-1, count], np.int64))

    def model(self, inputs: dict[str, Any], outputs: dict[str, Any]) -> Any:
        """All of it as a checked `onnx.ModelProto`; inputs and outputs by their sizes in a row."""
        helper = self._onnx.helper

        def described(sizes: dict[str, Any]) -> list[Any]:
            kind = self._onnx.TensorProto.FLOAT
            return [
                helper.make_tensor_value_info(name, kind, ["batch", *size])
                for name, size in sizes.items()
            ]

        graph = helper.make_graph(
            self._nodes, "policy", described(inputs), described(outputs), self._constants
        )
        opset = [helper.make_opsetid("", _OPSET)]
        model = helper.make_model(
            graph, opset_imports=opset, ir_version=_IR, producer_name="palpate"
        )
        self._onnx.checker.check_model(model, full_check=True)
        return model
