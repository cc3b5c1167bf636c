"""Functions of ``import fauio`` that combine several parts of the program; docs/library.md lists all."""

import os
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path

from adapters.batch import Batch
from adapters.logs.recordings import Recording, read_batches
from gains.analysis.check import Check, check_plant
from gains.plants.model_file import load_model
from gains.plants.plant import Plant
from gains.synthesis.certificate import certify
from gains.synthesis.compilation import compile_gains
from gains.synthesis.convex import design_convex
from gains.synthesis.gains_file import Gains
from monitor.event import AlarmEvent
from monitor.fitting.flights import part_of
from monitor.fitting.kept_flights import kept_model
from monitor.profile import Profile, read_profile
from monitor.vehicles.kinds import fit_reading
from replay.fit import FitReport, fit_profile, name_by_folder
from replay.player import Replay, interests, play_batches


def replay(
    profile: Profile | str | os.PathLike[str],
    recording: str | os.PathLike[str] | Iterable[Batch],
    *,
    vehicle: str | None = None,
    record: str | os.PathLike[str] | None = None,
    keep_traces: bool = False,
    on_event: Callable[[AlarmEvent], None] | None = None,
    force: bool = False,
) -> Replay:
    """Look for faults in a recording.

    Use this for recordings, whole or cut with :func:`fauio.read_batches`; use :class:`fauio.Pipeline` if telemetry
    arrives bit by bit or estimates are needed at once.

    Parameters
    ----------
    profile : Profile | str | PathLike
        The vehicle's profile, or its folder.
    recording : str | PathLike | Iterable[Batch]
        A recording (.tlog, .mcap, .ulg, .bin, also compressed), a folder of a session, or batches.
    vehicle : str | None
        Name of the vehicle in events; None: the profile's.
    record : str | PathLike | None
        MCAP file to write telemetry, estimates and alarms to.
    keep_traces : bool
        Whether to keep all estimates, as :attr:`Replay.traces`.
    on_event : Callable[[AlarmEvent], None] | None
        Called with each alarm event as it arises.
    force : bool
        Whether to go on if the recording reports another vehicle than the profile's.

    Raises
    ------
    ProfileError, TelemetryError
        The profile or the recording cannot be used, or the recording reports another vehicle.

    Examples
    --------
    >>> import fauio
    >>> found = fauio.replay("replay/data/quad", "replay/data/copter_motor1.tlog.xz")
    >>> [event.channel for event in found.events if event.state == "raised"]
    ['motor1']
    """
    used = profile if isinstance(profile, Profile) else read_profile(Path(profile))
    batches: Iterable[Batch]
    if isinstance(recording, str | os.PathLike):
        batches = read_batches(recording, None if record is not None else interests(used))
    else:
        batches = recording
    target = None if record is None else Path(record)
    return play_batches(
        used, batches, vehicle=vehicle, record=target, keep_traces=keep_traces, on_event=on_event, force=force
    )


def fit(
    kind: str,
    recordings: Sequence[str | os.PathLike[str]],
    folder: str | os.PathLike[str],
    *,
    name: str | None = None,
    model: str | os.PathLike[str] | None = None,
    force: bool = False,
    rate_hz: float | None = None,
    start_s: float = 0.0,
    end_s: float | None = None,
    update: bool = False,
) -> FitReport:
    """Learn a vehicle from recordings of healthy flights and write its profile, as ``fauio fit`` does.

    Use this once for each vehicle, or type of vehicle; :func:`fauio.read_profile` reads the folder.

    Parameters
    ----------
    kind : str
        Kind of vehicle: ``multirotor``, ``plane``, ``rover``, ``inertial`` or ``custom``.
    recordings : Sequence[str | PathLike]
        The recordings, minutes of healthy motion in all.
    folder : str | PathLike
        Folder to which the profile is written.
    name : str | None
        Name of the profile; None: the folder's.
    model : str | PathLike | None
        Plant model with free parameters; only for ``custom``.
    force : bool
        Whether to go on if a recording reports another kind of vehicle, or another vehicle than the first recording.
    rate_hz : float | None
        Samples per second of the vehicle's own observer; None: as fast as its messages allow.
    start_s, end_s : float
        Begin and end of the part of each recording that is fitted, seconds since its first message.
    update : bool
        Whether the folder is a profile that learns these recordings beside the flights that it keeps.

    Raises
    ------
    UsageError, TelemetryError, ModelError, InfeasibleError
        The recordings do not hold what is needed, excite too little, or allow no certified design.

    Examples
    --------
    >>> fauio.fit("multirotor", ["monday.tlog", "tuesday.tlog"], "quad/")  # doctest: +SKIP
    """
    own_model = None if model is None else Path(model)
    into = Path(folder)
    wanted, types = fit_reading(own_model or (kept_model(into) if update else None))

    def log(path: str) -> Iterable[Batch]:
        batches = Recording(path, wanted, types=types).batches()
        return batches if not start_s and end_s is None else part_of(batches, start_s, end_s, path)

    names = [os.fspath(path) for path in recordings]
    return fit_profile(
        kind,
        [partial(log, path) for path in names],
        into,
        name or (read_profile(into).name if update else name_by_folder(into)),
        own_model,
        log_names=names,
        force=force,
        rate_hz=rate_hz,
        update=into if update else None,
    )


def check(model: Plant | str | os.PathLike[str], rate_hz: float | None = None) -> Check:
    """Find out which faults of a plant its sensors can tell apart, and what would help with the others.

    Use this before :func:`fauio.design`: it explains why a plant has no design.

    Parameters
    ----------
    model : Plant | str | PathLike
        A plant, a model file or the name of a built-in model.
    rate_hz : float | None
        Samples per second at which a continuous model is observed; None: the model is examined unsampled.

    Raises
    ------
    ModelError, InfeasibleError
        The model cannot be used or has no faults.

    Examples
    --------
    >>> fauio.check("arm", 100.0).estimable
    True
    """
    return check_plant(_plant(model), rate_hz)


def design(
    model: Plant | str | os.PathLike[str],
    rate_hz: float | None = None,
    *,
    faults: Sequence[str] | None = None,
    pole_radius: float = 1.0,
    h2: float = 0.0,
) -> Gains:
    """Design the observer of a plant, certify it and compile it to the gains that run.

    Use this for a plant of your own; :func:`fauio.fit` designs the observers of vehicles by itself.
    :func:`fauio.write_gains` writes the file that a profile needs.

    Parameters
    ----------
    model : Plant | str | PathLike
        A plant, a model file or the name of a built-in model.
    rate_hz : float | None
        Samples per second; None: the rate of a discrete model.
    faults : Sequence[str] | None
        Names of the model's faults to estimate; None: all.
    pole_radius : float
        Largest magnitude of a pole of the error, at most 1: a smaller one forgets faster and passes more noise.
    h2 : float
        Weight of the passed noise, relative to the worst case.

    Raises
    ------
    ModelError
        The model cannot be used.
    InfeasibleError
        No observer of this kind exists; :func:`fauio.check` says why.
    InaccurateError
        The solver's answer could not be certified.

    Examples
    --------
    >>> gains = fauio.design("arm", 100.0)
    >>> gains.faults
    ('motor', 'encoder')
    """
    plant = _plant(model)
    if faults is not None:
        from gains.analysis.estimability import restricted

        plant = restricted(plant, tuple(faults))
    designed = design_convex(plant, rate_hz, pole_radius=pole_radius, h2=h2)
    return compile_gains(plant, designed, certify(plant, designed))


def _plant(model: Plant | str | os.PathLike[str]) -> Plant:
    return model if isinstance(model, Plant) else load_model(os.fspath(model))
