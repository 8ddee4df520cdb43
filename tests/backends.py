"""Parts of a law as a user's, which the step in C calls back."""

from dataclasses import fields, replace
from typing import Any

import numpy as np

from stewart_drake.law.predictors import NonlinearPredictor, PredictedState
from stewart_drake.scenario.signals import POSE


def own(part: Any) -> Any:
    """Return a part as one of a class of the user's."""
    kind = type("Own", (type(part),), {})
    return kind(**{one.name: getattr(part, one.name) for one in fields(part)})


def with_own(law: Any, *names: str) -> Any:
    """Return a law with some parts as a user's."""
    return replace(law, **{name: own(getattr(law, name)) for name in names})


class Predicted(NonlinearPredictor):
    """The prediction of core/law.c, under a delay of whole and broken periods."""

    def predict(self, belief, integral, queue, wanted, plant):
        timeline = belief.timeline
        schedule = timeline.schedule(queue)
        states = plant.predict(belief.state, schedule, belief.parameters)
        states = np.vstack([belief.state, states[timeline.per_period - 1 :: timeline.per_period]])
        errors = states[: len(wanted)] - wanted
        parts = np.split(schedule.torques, max(timeline.steps, 1))
        for torques, a, b in zip(parts, errors, errors[1:], strict=False):
            if not plant.motors.reached(torques):
                integral = integral + timeline.period / 2 * (a + b)[POSE]
        return PredictedState(states[-1], errors[-1], integral)
