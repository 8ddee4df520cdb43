"""Options of a live run and of a simulated machine; nothing heavy is imported here."""

from pathlib import Path
from typing import Literal

from stewart_drake.studies.options import Options, option, refuse


class Settings(Options):
    rate: float = option(1.0, "Speed of the machine's clock, 1: real time.", ge=1e-3, le=1e3)
    watchdog: float = option(
        1.0, "Seconds of silence before the safe torque, or held setpoint.", ge=1e-2, le=1e4
    )
    safe: Literal["zero", "hold"] = option(
        "zero", "Safe torque: zero, or the last one. Servos hold their setpoint."
    )
    restart: Literal["rest", "motion"] = option(
        "rest",
        "Start of a new session: reset, or as it is. A plate that has left "
        "its workspace is put back.",
    )


class MachineOptions(Settings):
    port: int = option(47000, "UDP port; 0: any free one.", ge=0, le=65535)
    host: str = option("127.0.0.1", "Address to listen at; beyond loopback with a key.")
    key: Path | None = option(None, "File with the shared key.", "FILE")
    duration: float = option(0.0, "Seconds after which the machine ends; 0: at Ctrl-C.", ge=0)
    log: Path | None = option(None, "Log to write during the run, .mcap or .csv.", "FILE")
    reachy: str | None = option(
        None, "Drive Reachy Mini through its daemon instead of a simulation.", "HOST:PORT"
    )
    ahead: float = option(
        0.0,
        "With --reachy: seconds by which setpoints go ahead, for the robot's delay.",
        ge=0,
        le=1,
    )


class LiveOptions(Options):
    duration: float | None = option(
        None, "Duration, s; until it is stopped by default.", "S", ge=0.1
    )
    hold: bool = option(False, "At the end hold the plate at rest until Ctrl-C.")
    armed: bool = option(False, "Drive a real machine.", name="arm")
    key: Path | None = option(None, "File with the shared key.", "FILE")
    max_missing: float | None = option(
        None,
        "Longest gap of measurements; by the estimator's uncertainty by default.",
        "SECONDS",
        ge=0.001,
    )
    accept_jitter: bool = option(
        False, "Start without the question that a large jitter raises.", name="yes"
    )
    log: Path | None = option(None, "Log to write during the run, .mcap or .csv.", "FILE")
    learn: int = option(0, "Repetitions from which torques or setpoints are learned.", ge=0, le=100)
    learned: Path | None = option(
        None, "File for what was learned; learned.npz by default.", "FILE"
    )
    mirror: str | None = option(
        None, "Send each sample as JSON over UDP, for PlotJuggler.", "HOST:PORT"
    )

    def check_learned(self) -> None:
        """Refuse options that count only with learning, or only without."""
        if not self.learn:
            refuse({"learned": self.learned}, "without --learn; expected both or neither")
            return
        unused = self.model_dump(include={"duration", "log", "mirror"})
        refuse({**unused, "hold": self.hold or None}, "with --learn; expected none")
