"""`python -m stewart_drake.dynamics.generate` writes native/equations.h from the equations.

The expressions are those of `dynamics.virtual_machine`, for any machine: its numbers
(`native.layout.geometry_of`) are arguments. What is written for one leg is a loop of six, which a
compiler can do for several legs at a time. native/dynamics.c calls what is written here.
"""

from pathlib import Path
from typing import Final

import casadi as ca

from stewart_drake.dynamics import derivatives, equations, measures
from stewart_drake.dynamics.emit import Input, Output, c_function
from stewart_drake.dynamics.equations import PlateMotion, Sums
from stewart_drake.dynamics.numbers import common_numbers, leg_numbers
from stewart_drake.native.layout import COMMON_NUMBERS, GEOMETRY, LEG_NUMBERS
from stewart_drake.scenario.signals import NUM_PARAMETERS

FILE: Final = Path(__file__).resolve().parents[1] / "native" / "equations.h"

_HEAD: Final = f"""/* Written by python -m stewart_drake.dynamics.generate; not by hand. */

#define PARAMETERS {NUM_PARAMETERS}
#define GEOMETRY {GEOMETRY}
#define LEG_NUMBERS {LEG_NUMBERS}

typedef const real fixed;

#define MIN(x, y) ((x) < (y) ? (x) : (y))
#define MAX(x, y) ((x) > (y) ? (x) : (y))
#define SIGN(x) ((x) > 0 ? 1 : (x) < 0 ? -1 : (x))
"""


def equations_in_c() -> str:
    """The text of equations.h."""
    return "\n".join([_HEAD, *_motion(), *_derivatives(), *_measures()])


def _joined(*parts: ca.SX) -> ca.SX:
    return ca.vertcat(*(ca.vec(ca.densify(part)) for part in parts))


def _inputs(s: dict[str, ca.SX], names: str) -> list[Input]:
    return [Input(name, s[name]) for name in names.split()]


def _numbers() -> tuple[Input, Input]:
    common = Input("common", ca.SX.sym("common", COMMON_NUMBERS))
    return common, Input("legs", ca.SX.sym("leg", LEG_NUMBERS), own=True)


def _lower(sums: Sums) -> ca.SX:
    """Each number once (28,)."""
    M_ww, M_wv, M_vv, *rest = sums
    triangles = [
        ca.vertcat(*(M[i, j] for i in range(3) for j in range(i + 1))) for M in (M_ww, M_vv)
    ]
    return _joined(triangles[0], M_wv, triangles[1], *rest)


def _sums(numbers: ca.SX) -> Sums:
    M_ww, M_wv, M_vv, h_w, h_v, energy = ca.vertsplit(numbers, [0, 6, 15, 21, 24, 27, 28])
    whole = []
    for triangle in (M_ww, M_vv):
        a, b, c, d, e, f = ca.vertsplit(triangle)
        whole.append(ca.vertcat(ca.horzcat(a, b, d), ca.horzcat(b, c, e), ca.horzcat(d, e, f)))
    return Sums(whole[0], ca.reshape(M_wv, 3, 3), whole[1], h_w, h_v, energy)


def _motion() -> list[str]:
    """plate, leg by leg, and what is made of their sums."""
    s, (common, legs) = equations.symbols(), _numbers()
    plate = equations.plate_motion(s["pose"], s["rates"], s["gravity"])
    alone = equations.plate_alone(common_numbers(common.symbols), plate, s["parameters"])
    moving = Input("plate", ca.SX.sym("plate", 21))
    R_WP, *vectors = ca.vertsplit(moving.symbols, [0, 9, 12, 15, 18, 21])
    added, arm = equations.leg_on_plate(
        leg_numbers(legs.symbols),
        common_numbers(common.symbols),
        PlateMotion(ca.reshape(R_WP, 3, 3), *vectors),
    )
    sums, arms = Input("sums", ca.SX.sym("sums", 28)), Input("arms", ca.SX.sym("arms", 6, 6))
    whole = equations.assembled(_sums(sums.symbols), arms.symbols, s["pose"], s["rates"])
    p = s["parameters"]
    forward = equations.accelerations(whole, s["torque"], p)
    inverse = equations.inverse_dynamics(whole, s["accelerations"], p)
    M, h, B = equations.terms(whole)
    state = _inputs(s, "pose rates")
    return [
        c_function(
            "plate_motion",
            [*_inputs(s, "pose rates parameters gravity"), common],
            [Output("plate", _joined(*plate)), Output("sums", _lower(alone))],
        ),
        c_function(
            "leg_motion",
            [moving, common, legs],
            [Output("added", _lower(added)), Output("arms", arm)],
        ),
        c_function(
            "solve_accelerations",
            [*state, *_inputs(s, "torque parameters"), sums, arms],
            [Output("accelerations", forward)],
        ),
        c_function(
            "solve_torque",
            [*state, *_inputs(s, "accelerations parameters"), sums, arms],
            [Output("torque", inverse)],
        ),
        c_function(
            "pose_terms",
            [*state, sums, arms],
            [Output("M", M), Output("h", h), Output("B", B)],
        ),
    ]


def _derivatives() -> list[str]:
    s, (common, legs) = equations.symbols(), _numbers()
    torque = Input("torque", ca.SX.sym("torque"), own=True)
    bias = Input("bias", ca.SX.sym("bias"), own=True)
    dF_dx, M = derivatives.plate_alone(common_numbers(common.symbols), s)
    change, turn, mass, arm, rate = derivatives.leg_on_plate(
        leg_numbers(legs.symbols), common_numbers(common.symbols), s, torque.symbols + bias.symbols
    )
    change[:3, :] -= turn
    both = Input("dF_dx", ca.SX.sym("dF_dx", 6, 12)), Input("M", ca.SX.sym("M", 6, 6))
    arms, arm_rates = Input("arms", ca.SX.sym("arms", 6, 6)), Input("rates", ca.SX.sym("rates", 6))
    whole = derivatives.assembled(
        both[0].symbols, both[1].symbols, arms.symbols, arm_rates.symbols, s
    )
    plain = _inputs(s, "pose rates accelerations")
    return [
        c_function(
            "plate_derivatives",
            [*plain, *_inputs(s, "parameters"), common],
            [Output("dF_dx", dF_dx), Output("M", M)],
        ),
        c_function(
            "leg_derivatives",
            [*plain, *_inputs(s, "parameters gravity"), common, legs, torque, bias],
            [
                Output("dF_dx", change),
                Output("M", mass),
                Output("arms", arm),
                Output("arm_rates", rate),
            ],
        ),
        c_function(
            "pose_derivatives",
            [*_inputs(s, "pose accelerations gravity"), both[1], arms, arm_rates],
            [Output("dF_dp", whole[1]), Output("MN", whole[2])],
        ),
    ]


def _measures() -> list[str]:
    s, (common, legs) = equations.symbols(), _numbers()
    angle = Input("angles", ca.SX.sym("angle"), own=True)
    found = []
    for name, own in (("leg_measures", None), ("leg_measures_of_tree", angle)):
        sine, wrench = measures.leg_measures(
            leg_numbers(legs.symbols),
            common_numbers(common.symbols),
            equations.rotation(s["pose"][:3]),
            s["pose"][3:],
            None if own is None else own.symbols,
        )
        inputs = [*_inputs(s, "pose"), common, legs, *([] if own is None else [own])]
        found.append(c_function(name, inputs, [Output("sines", sine), Output("wrenches", wrench)]))
    sines = Input("sines", ca.SX.sym("sines", 6))
    wrenches = Input("wrenches", ca.SX.sym("wrenches", 6, 6))  # a row per leg
    whole = measures.assembled(sines.symbols, wrenches.symbols.T, s["pose"])
    inputs = [*_inputs(s, "pose"), sines, wrenches]
    return [*found, c_function("all_measures", inputs, [Output("measures", whole)])]


if __name__ == "__main__":
    FILE.write_text(equations_in_c())
