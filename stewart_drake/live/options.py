"""Options of a live run and of a simulated machine; nothing heavy is imported here."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from stewart_drake.studies.options import Flag, Options

Key = Annotated[Path | None, Field(description="File whose bytes both sides share."), Flag("FILE")]


class Settings(Options):
    """How a machine is run."""

    rate: Annotated[
        float, Field(ge=1e-3, le=1e3, description="Seconds of the machine in a second."), Flag()
    ] = 1.0
    watchdog: Annotated[
        float,
        Field(ge=1e-2, le=1e4, description="Seconds of silence before the safe torque."),
        Flag(),
    ] = 1.0
    safe: Annotated[
        Literal["zero", "hold"],
        Field(description="The safe torque: none, or the last one."),
        Flag(),
    ] = "zero"
    restart: Annotated[
        Literal["rest", "motion"],
        Field(
            description="Where a new session begins: put back, or as it is. A plate that has left "
            "its workspace is put back."
        ),
        Flag(),
    ] = "rest"


class MachineOptions(Settings):
    """Options of a simulated machine in real time."""

    port: Annotated[int, Field(ge=0, le=65535, description="UDP; 0 is any."), Flag()] = 47000
    host: Annotated[str, Field(description="To listen at; beyond loopback with a key."), Flag()] = (
        "127.0.0.1"
    )
    key: Key = None
    duration: Annotated[
        float,
        Field(ge=0, description="Seconds of the machine, then it ends; 0: until Ctrl-C."),
        Flag(),
    ] = 0.0


class LiveOptions(Options):
    """Options of the loop in real time."""

    duration: Annotated[
        float | None, Field(ge=0.1, description="s; until it is stopped by default."), Flag("S")
    ] = None
    armed: Annotated[
        bool, Field(description="Drive a machine that is no simulation."), Flag(name="arm")
    ] = False
    key: Key = None
    max_missing: Annotated[
        float | None,
        Field(
            ge=0.001,
            description="Without measurements, then it ends; by the estimator's uncertainty by "
            "default.",
        ),
        Flag("SECONDS"),
    ] = None
    accept_jitter: Annotated[
        bool,
        Field(description="Start without the question that a large jitter raises."),
        Flag(name="yes"),
    ] = False
