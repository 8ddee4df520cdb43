"""CasADi expressions as plain C: straight lines of operations, and one loop over the legs."""

from collections.abc import Sequence
from typing import Final, NamedTuple

import casadi as ca

_UNARY: Final = {
    ca.OP_ASSIGN: "{0}",
    ca.OP_NEG: "-{0}",
    ca.OP_INV: "1 / {0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "2 * {0}",
    ca.OP_SQRT: "REAL(sqrt)({0})",
    ca.OP_SIN: "REAL(sin)({0})",
    ca.OP_COS: "REAL(cos)({0})",
    ca.OP_ACOS: "REAL(acos)({0})",
    ca.OP_FABS: "REAL(fabs)({0})",
    ca.OP_SIGN: "SIGN({0})",
    ca.OP_NOT: "!{0}",
}
_BINARY: Final = {
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_LT: "{0} < {1}",
    ca.OP_LE: "{0} <= {1}",
    ca.OP_EQ: "{0} == {1}",
    ca.OP_NE: "{0} != {1}",
    ca.OP_FMIN: "MIN({0}, {1})",
    ca.OP_FMAX: "MAX({0}, {1})",
    ca.OP_ATAN2: "REAL(atan2)({0}, {1})",
}
_FORMS: Final = _UNARY | _BINARY


class Input(NamedTuple):
    """An argument: its name in C, its symbols, and whether each leg has its own, `name[n][6]`."""

    name: str
    symbols: ca.SX
    own: bool = False


class Output(NamedTuple):
    """A result; those of each leg, `name[n][6]`, in a function with arguments of the legs."""

    name: str
    value: ca.SX


def c_function(name: str, inputs: Sequence[Input], outputs: Sequence[Output]) -> str:
    """The text of a static C function, by columns; what is the same for all legs is done once."""
    values = [ca.densify(output.value) for output in outputs]
    function = ca.Function(name, [i.symbols for i in inputs], values, {"cse": True})
    looped = any(i.own for i in inputs)
    before, inside = _statements(function, inputs, outputs, looped)
    parameters = [f"fixed *restrict {i.name}" for i in inputs]
    parameters += [f"real *restrict {o.name}" for o in outputs]
    lines = [f"static void {name}({', '.join(parameters)})", "{"]
    lines += [f"    {line}" for line in before]
    if looped:
        lines += ["    for (int leg = 0; leg < 6; leg++) {"]
        lines += [f"        {line}" for line in inside]
        lines += ["    }"]
    return "\n".join([*lines, "}"]) + "\n"


def _statements(
    function: ca.Function, inputs: Sequence[Input], outputs: Sequence[Output], looped: bool
) -> tuple[list[str], list[str]]:
    """Those before the loop over the legs, those inside."""
    before: list[str] = []
    inside: list[str] = []
    held: dict[int, tuple[str, bool]] = {}  # what a place of CasADi's work vector holds
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        to, of = function.instruction_output(k), function.instruction_input(k)
        if operation == ca.OP_OUTPUT:
            place = f"[{6 * to[1]} + leg]" if looped else f"[{to[1]}]"
            target = inside if looped else before
            target.append(f"{outputs[to[0]].name}{place} = {held[of[0]][0]};")
        elif operation == ca.OP_INPUT:
            source = inputs[of[0]]
            place = f"[{6 * of[1]} + leg]" if source.own else f"[{of[1]}]"
            held[to[0]] = source.name + place, source.own
        elif operation == ca.OP_CONST:
            held[to[0]] = _literal(function.instruction_constant(k)), False
        else:
            operands = [held[place] for place in of]
            text = _FORMS[operation].format(*(_factor(operand) for operand, _ in operands))
            own = any(own for _, own in operands)
            (inside if own else before).append(f"fixed a{k} = {text};")
            held[to[0]] = f"a{k}", own
    return before, inside


def _factor(operand: str) -> str:
    return f"({operand})" if operand.startswith("-") else operand


def _literal(value: float) -> str:
    return f"(real){value!r}"
