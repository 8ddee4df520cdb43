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
from stewart_drake.scenario.signals import COULOMB, COULOMB_SPEED, NUM_PLANT_PARAMETERS

FILE: Final = Path(__file__).resolve().parents[1] / "native" / "equations.h"

_HEAD: Final = f"""/* Written by python -m stewart_drake.dynamics.generate; not by hand. */

#define PARAMETERS {NUM_PLANT_PARAMETERS}
#define COULOMB {COULOMB}
#define COULOMB_SPEED {COULOMB_SPEED}
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
    platform = Input("plate", ca.SX.sym("plate", 21))
    R_WP, *vectors = ca.vertsplit(platform.symbols, [0, 9, 12, 15, 18, 21])
    of_plate = PlateMotion(ca.reshape(R_WP, 3, 3), *vectors)
    added, arm, crank_rate = equations.leg_on_plate(
        leg_numbers(legs.symbols), common_numbers(common.symbols), of_plate
    )
    sums, arms = Input("sums", ca.SX.sym("sums", 28)), Input("arms", ca.SX.sym("arms", 6, 6))
    moving = tuple(Input(name, ca.SX.sym(name, 6)) for name in ("crank_rates", "slip"))
    rates, slip = (i.symbols for i in moving)
    whole = equations.assembled(_sums(sums.symbols), arms.symbols, rates, s["pose"], s["rates"])
    p = s["parameters"]
    forward = equations.accelerations(whole, s["torque"], p, slip)
    inverse = equations.inverse_dynamics(whole, s["accelerations"], p, slip)
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
            [platform, common, legs],
            [
                Output("added", _lower(added)),
                Output("arms", arm),
                Output("crank_rates", crank_rate),
            ],
        ),
        c_function(
            "solve_accelerations",
            [*state, *_inputs(s, "torque parameters"), *moving, sums, arms],
            [Output("accelerations", forward)],
        ),
        c_function(
            "solve_torque",
            [*state, *_inputs(s, "accelerations parameters"), *moving, sums, arms],
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
    own = [Input(name, ca.SX.sym(name), own=True) for name in ("torque", "bias", "slip")]
    leg, of_all = leg_numbers(legs.symbols), common_numbers(common.symbols)
    dF_dx, M = derivatives.plate_alone(of_all, s)
    crank_rate = derivatives.crank_rate(leg, of_all, s)
    change, turn, mass, arm, _ = derivatives.leg_on_plate(leg, of_all, s, *(i.symbols for i in own))
    change[:3, :] -= turn
    M_sum, arms = (Input(name, ca.SX.sym(name, 6, 6)) for name in ("M", "arms"))
    arm_rates, slips = (Input(name, ca.SX.sym(name, 6)) for name in ("arm_rates", "slips"))
    _, dF_dp, MN, _ = derivatives.assembled(
        dF_dx, M_sum.symbols, arms.symbols, arm_rates.symbols, slips.symbols, s
    )
    plain = _inputs(s, "pose rates accelerations")
    return [
        c_function(
            "plate_derivatives",
            [*plain, *_inputs(s, "parameters gravity"), common],
            [Output("dF_dx", dF_dx), Output("M", M)],
        ),
        c_function(
            "crank_rates",
            [*_inputs(s, "pose rates"), legs],
            [Output("arm_rates", crank_rate)],
        ),
        c_function(
            "leg_derivatives",
            [*plain, *_inputs(s, "parameters gravity"), common, legs, *own],
            [Output("dF_dx", change), Output("M", mass), Output("arms", arm)],
        ),
        c_function(
            "pose_derivatives",
            [*plain, *_inputs(s, "parameters gravity"), M_sum, arms, arm_rates, slips],
            [Output("dF_dp", dF_dp), Output("MN", MN)],
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
