"""Compute a graph with fewer and wider operators.

A runtime spends some 0.25 us per operator on one pose, whatever it computes. Operators of one kind that do not wait for
each other become one on several columns, whose operands are affine combinations of columns found before: one product
with a matrix each (superword-level parallelism, Larsen and Amarasinghe 2000).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from onnx import helper

from jawusd.geometry.arrays import Array
from jawusd.rig.onnx_columns import OUTPUT, STEP, Atom, Forms, Operator, Reading
from jawusd.rig.onnx_graph import Graph, Value


def packed(g: Graph, inputs: Mapping[str, int], outputs: Sequence[str]) -> Graph:
    """Return a graph that computes the same.

    Args:
        g: The graph: rows (n, k) in, and operators that take each row by itself.
        inputs: Its inputs, and their widths.
        outputs: Names of its outputs.
    """
    reading = Reading(g.nodes, g.initializers, inputs)
    operators = list(reading.operators)
    made = {operator.output for operator in operators}
    operators += [
        Operator(OUTPUT, [reading.columns[name]], name, 0, alone=True) for name in outputs if name not in made
    ]
    writing = _Writing(Graph(g.dtype, f"{g.prefix}p_"), inputs, reading.constants, outputs)
    for together in _steps(operators, {*inputs, *reading.constants}):
        writing.add(together)
    return writing.graph


def _steps(operators: list[Operator], known: set[str]) -> list[list[Operator]]:
    """Return the operators in steps: no more of them than the longest way through the graph, and few kinds in each.

    A step computes the operators that most others wait for, and all of the same kinds that can be computed by then.
    """
    ways = _ways(operators)
    steps, pending, known = [], operators, set(known)
    while pending:
        ready = [operator for operator in pending if operator.needs <= known]
        longest = max(ways[operator.output] for operator in ready)
        kinds = {_group(operator) for operator in ready if ways[operator.output] == longest}
        steps.append([operator for operator in ready if _group(operator) in kinds])
        done = {operator.output for operator in steps[-1]}
        pending = [operator for operator in pending if operator.output not in done]
        known |= done
    return steps


def _ways(operators: list[Operator]) -> dict[str, int]:
    """Return how many operators wait for each one, one after another."""
    ways: dict[str, int] = {}
    for operator in reversed(operators):
        ways[operator.output] = ways.get(operator.output, 0)
        for name in operator.needs:
            ways[name] = max(ways.get(name, 0), ways[operator.output] + 1)
    return ways


def _group(operator: Operator) -> tuple[str, ...]:
    """Return what operators that are computed together have in common."""
    names = [operand for operand in operator.operands if isinstance(operand, str)]
    return (operator.kind, *names, operator.output if operator.alone else "")


class _Writing:
    """A graph that is written step by step.

    Attributes:
        graph: The graph.
    """

    def __init__(
        self, graph: Graph, inputs: Mapping[str, int], constants: Mapping[str, Array], outputs: Sequence[str]
    ) -> None:
        self.graph = graph
        self._constants, self._outputs = constants, outputs
        self._widths = dict(inputs)
        self._values = {name: Value(graph, name) for name in inputs}
        self._places: dict[Atom, Atom] = {}  # where columns are that were computed together with others

    def add(self, together: Sequence[Operator]) -> None:
        """Add the operators of a step."""
        groups: dict[tuple[str, ...], list[Operator]] = {}
        for operator in together:
            groups.setdefault(_group(operator), []).append(operator)
        wanted = [_operands(group) for group in groups.values()]
        for group, operands in zip(groups.values(), wanted):
            first = group[0]
            name = first.output if first.output in self._outputs else None
            if first.kind == OUTPUT:
                self._operand(operands[0], name)
            else:
                values = [self._operand(operand) for operand in operands]
                self._keep(group, self._computed(first, values, name))

    def _computed(self, operator: Operator, values: list[Value], name: str | None) -> Value:
        if operator.kind == STEP:
            return self.graph.op("Cast", self.graph.op("GreaterOrEqual", *values), to=self.graph.elem_type)
        attributes = {a.name: helper.get_attribute_value(a) for a in operator.attributes}
        return self.graph.op(operator.kind, *values, name=name, **attributes)

    def _keep(self, group: Sequence[Operator], value: Value) -> None:
        """Remember where the columns of operators are that were computed together."""
        first, column = group[0].output, 0
        self._values[first], self._widths[first] = value, sum(operator.width for operator in group)
        for operator in group:
            for own in range(operator.width):
                self._places[operator.output, own] = (first, column)
                column += 1

    def _operand(self, wanted: Forms | str, name: str | None = None) -> Value:
        """Return a value by its name, or the columns wanted, as an output of the graph if it has a name."""
        if not isinstance(wanted, str):
            return self._combined(wanted, name)
        if wanted in self._values:
            return self._values[wanted]
        array = self._constants[wanted]
        return self.graph.constant(array, np.int64 if array.dtype.kind == "i" else None)

    def _combined(self, forms: Forms, name: str | None) -> Value:
        """Return columns combined of values: a product with a matrix, where they are not one of the values itself."""
        weights = [{self._places.get(atom, atom): x for atom, x in form.weights.items()} for form in forms]
        found = {value for each in weights for value, _ in each}
        names = [value for value in self._widths if value in found]
        shift = np.array([[form.constant for form in forms]])
        if not names:
            return self.graph.constant(shift)
        first = dict(zip(names, np.cumsum([0, *(self._widths[value] for value in names)]).tolist()))
        matrix = np.zeros((sum(self._widths[value] for value in names), len(forms)))
        for column, each in enumerate(weights):
            for (value, place), weight in each.items():
                matrix[first[value] + place, column] = weight
        values = [self._values[value] for value in names]
        joined = values[0] if len(values) == 1 else self.graph.concat(values)
        if name is None and np.array_equal(matrix, np.eye(len(matrix))) and not shift.any():
            return joined
        constants = [self.graph.constant(x) for x in ([matrix, shift] if shift.any() else [matrix])]
        return self.graph.op("Gemm", joined, *constants, name=name)


def _operands(group: Sequence[Operator]) -> list[Forms | str]:
    """Return the operands of operators that are computed together, side by side."""
    together: list[Forms | str] = []
    for place, first in enumerate(group[0].operands):
        if isinstance(first, str):
            together.append(first)
        else:
            operands = [operator.operands[place] for operator in group]
            together.append([form for operand in operands if not isinstance(operand, str) for form in operand])
    return together
