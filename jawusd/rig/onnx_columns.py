"""Read a graph of operators on columns as affine combinations and the operators between them.

What is added, scaled, joined, split or multiplied with a constant matrix takes no operator of its own: all that is an
affine combination of columns that other operators gave. What is left are `Operator`s, whose operands are such
combinations; `jawusd.rig.onnx_packing` computes many of them at once.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import onnx
from onnx import helper, numpy_helper

from jawusd.geometry.arrays import Array

#: Values with more columns are computed by themselves, and combinations of more than that many columns by operators:
#: the zeros of a matrix would cost more than the operator.
WIDE = 48

_ELEMENTWISE = ("Add", "Sub", "Mul", "Div", "Max", "Min", "Clip", "Where", "Sqrt", "Exp", "Log", "Sin")
_NO_COLUMNS = ("Reshape", "Squeeze", "Less")  # what they give is not combined further
_CONSTANT_OPERANDS = ("Reshape", "Squeeze", "Less", "Clip", "ReduceSum")

Atom = tuple[str, int]  # a column: the name of a value, and which of its columns


@dataclass(frozen=True)
class Form:
    """An affine combination of columns: the sum of weights times columns, and a constant."""

    weights: Mapping[Atom, float]
    constant: float = 0.0

    def plus(self, other: Form, factor: float) -> Form:
        """Return this form plus a factor times another one."""
        weights = dict(self.weights)
        for atom, weight in other.weights.items():
            weights[atom] = weights.get(atom, 0.0) + factor * weight
        return Form({atom: w for atom, w in weights.items() if w != 0.0}, self.constant + factor * other.constant)


Forms = list[Form]


@dataclass(frozen=True)
class Operator:
    """An operator that is not affine.

    Attributes:
        kind: Its name in ONNX; `STEP` stands for ``>=`` as a number, `OUTPUT` for a result that is affine.
        operands: Columns, or the name of a value that is no columns (a mask, a shape).
        output: Name of the result.
        width: Columns of the result; 0 if it is no columns.
        attributes: Of the ONNX operator.
        alone: Not to be computed together with others of its kind.
    """

    kind: str
    operands: Sequence[Forms | str]
    output: str
    width: int
    attributes: Sequence[onnx.AttributeProto] = ()
    alone: bool = False

    @cached_property
    def needs(self) -> set[str]:
        """The names of the values whose columns the operands combine, and of other values."""
        found = {operand for operand in self.operands if isinstance(operand, str)}
        forms = (form for operand in self.operands if not isinstance(operand, str) for form in operand)
        return found | {name for form in forms for name, _ in form.weights}


STEP, OUTPUT = "Step", "Output"


def atoms(forms: Iterable[Form]) -> set[Atom]:
    """Return the columns that forms combine."""
    return {atom for form in forms for atom in form.weights}


def is_constant(forms: Iterable[Form]) -> bool:
    """Tell whether forms combine no columns at all."""
    return not atoms(forms)


class Reading:
    """The columns and operators of a graph.

    Attributes:
        columns: The columns of each value, by name.
        operators: The operators, in the order of the graph.
        constants: Constants of the graph, by name.
    """

    def __init__(
        self, nodes: Sequence[onnx.NodeProto], constants: Sequence[onnx.TensorProto], inputs: Mapping[str, int]
    ) -> None:
        """Read the nodes of a graph.

        Args:
            nodes: In an order in which they can be computed.
            constants: Their constants.
            inputs: Inputs of the graph and their widths.

        Raises:
            NotImplementedError: An operator is none of those that are known to take each row by itself.
        """
        self.constants = {tensor.name: numpy_helper.to_array(tensor) for tensor in constants}
        self.columns = {name: _own(name, width) for name, width in inputs.items()}
        self.operators: list[Operator] = []
        self._steps: dict[str, Operator] = {}
        for name, array in self.constants.items():
            if array.dtype.kind == "f" and (array.ndim < 2 or array.shape[0] == 1) and array.ndim < 3:
                self.columns[name] = [Form({}, float(x)) for x in array.reshape(-1)]
        for node in nodes:
            self._read(node)

    def _read(self, node: onnx.NodeProto) -> None:
        kind, output = node.op_type, node.output[0]
        operands = [self._operand(name, kind, place) for place, name in enumerate(node.input)]
        folded = self._folded(node, operands)
        if folded is not None:
            self.columns.update(folded)
        elif kind == "GreaterOrEqual":  # a mask until it is cast
            self._steps[output] = Operator(STEP, _broadcast(operands), output, 0)
        elif kind == "Cast" and node.input[0] in self._steps:
            step = self._steps[node.input[0]]
            self._add(Operator(STEP, step.operands, output, len(step.operands[0])))
        elif kind in _NO_COLUMNS:
            self._add(Operator(kind, operands, output, 0, node.attribute, alone=True))
        elif kind == "ReduceMax":
            self._add(Operator(kind, operands, output, 1, node.attribute, alone=True))
        elif kind == "MatMul":
            width = self.constants[node.input[1]].shape[1]
            self._add(Operator("Gemm", operands, output, width, alone=True))
        elif kind in _ELEMENTWISE:
            operands = _broadcast(operands)
            width = max(len(operand) for operand in operands if not isinstance(operand, str))
            self._add(Operator(kind, operands, output, width, node.attribute, alone=width > WIDE))
        else:
            raise NotImplementedError(f"columns through the operator {kind}")

    def _operand(self, name: str, kind: str, place: int) -> Forms | str:
        """Return the columns of an operand; its name, if it is none or has to stay a constant."""
        if name not in self.columns or (place > 0 and kind in _CONSTANT_OPERANDS):
            return name
        return self.columns[name]

    def _add(self, operator: Operator) -> None:
        self.operators.append(operator)
        if operator.width:
            self.columns[operator.output] = _own(operator.output, operator.width)

    def _folded(self, node: onnx.NodeProto, operands: list[Forms | str]) -> dict[str, Forms] | None:
        """Return the columns of a node's outputs; None if it is not affine, or not worth a matrix."""
        kind = node.op_type
        first, *others = operands
        if isinstance(first, str) or kind in ("Where", "GreaterOrEqual"):
            return None
        if kind == "Split" and _axis(node) == 1:
            width = len(first) // len(node.output)
            return {name: first[i * width : (i + 1) * width] for i, name in enumerate(node.output)}
        forms: Forms | None = None
        if kind == "Concat" and _axis(node) == 1:
            forms = [form for operand in operands if not isinstance(operand, str) for form in operand]
        elif kind == "ReduceSum" and len(first) <= WIDE:
            forms = [_combined(first, np.ones(len(first)))]
        elif kind == "MatMul" and len(atoms(first)) <= WIDE:
            forms = _worth([_combined(first, column) for column in self.constants[node.input[1]].T.astype(float)])
        elif kind in ("Add", "Sub", "Mul", "Div") and not isinstance(others[0], str):
            width = max(len(first), len(others[0]))
            forms = _arithmetic(kind, _repeated(first, width), _repeated(others[0], width))
        return None if forms is None else {node.output[0]: forms}


def _arithmetic(kind: str, left: Forms, right: Forms) -> Forms | None:
    """Return the sum, difference, product or quotient of columns, if it is affine and worth a matrix."""
    if kind in ("Add", "Sub"):
        sign = 1.0 if kind == "Add" else -1.0
        return _worth([a.plus(b, sign) for a, b in zip(left, right)])
    if kind == "Mul" and is_constant(left):
        left, right = right, left
    if not is_constant(right):
        return None
    factors = [b.constant if kind == "Mul" else 1.0 / b.constant for b in right]
    return _worth([Form({}).plus(a, factor) for a, factor in zip(left, factors)])


def _worth(forms: Forms) -> Forms | None:
    """Return forms; None if a matrix would be mostly zeros."""
    return None if len(forms) > WIDE and len(atoms(forms)) > WIDE else forms


def _combined(forms: Forms, factors: Array) -> Form:
    total = Form({})
    for form, factor in zip(forms, factors.tolist()):
        if factor != 0.0:
            total = total.plus(form, factor)
    return total


def _broadcast(operands: Sequence[Forms | str]) -> list[Forms | str]:
    """Return operands with columns repeated to the width of the widest."""
    width = max(len(operand) for operand in operands if not isinstance(operand, str))
    return [operand if isinstance(operand, str) else _repeated(operand, width) for operand in operands]


def _repeated(forms: Forms, width: int) -> Forms:
    return forms * width if len(forms) == 1 else forms


def _own(name: str, width: int) -> Forms:
    return [Form({(name, column): 1.0}) for column in range(width)]


def _axis(node: onnx.NodeProto) -> int:
    return next(int(helper.get_attribute_value(a)) for a in node.attribute if a.name == "axis")
