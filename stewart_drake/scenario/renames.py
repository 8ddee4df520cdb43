"""Fields of scenarios that were renamed since 0.2.

A file that a person writes is refused with the new name, see `files.yamlio.validate`. A file that
the program wrote is read under the new names.
"""

from typing import Any, Final

CONTROLLER: Final = {
    "estimator": "estimate",
    "estimate_coulomb": "estimate",
    "estimate_offsets": "estimate",
    "quiet_start": "open_loop_start",
    "rejoin": "replan",
    "known": "calibration",
}
"""Old name -> new name in the section `controller`."""


def with_new_names(scenario: dict[str, Any]) -> dict[str, Any]:
    """Return the data of a scenario that the program wrote, 0.2 included, under the new names."""
    given = scenario.get("controller")
    if not isinstance(given, dict):
        return scenario
    controller = {CONTROLLER.get(name, name): value for name, value in given.items()}
    if "estimator" in given:
        asked = {name: given.get(f"estimate_{name}", False) for name in ("coulomb", "offsets")}
        chosen = ["torque_bias", "payload", "damping", *(name for name in asked if asked[name])]
        controller["estimate"] = chosen if given["estimator"] == "parameters" else []
    return scenario | {"controller": controller}
