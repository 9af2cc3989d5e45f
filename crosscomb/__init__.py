"""Virtual sensor for the vehicle sideslip angle.

What a program needs stands here and is imported when it is first asked for: `read_log`, `load_vehicle` and
`load_artefact` read a log, a vehicle file and a trained selector; `estimate_log` estimates a whole log,
`StreamingEstimator` one sample at a time.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from crosscomb.logs.read import read_log
    from crosscomb.models.vehicle import load_vehicle
    from crosscomb.run.estimate import estimate_log
    from crosscomb.run.stream import StreamingEstimator
    from crosscomb.selection.artefact import load_artefact

__version__ = "0.1.0"
__all__ = ["StreamingEstimator", "estimate_log", "load_artefact", "load_vehicle", "read_log"]

_PLACES = {
    "read_log": "crosscomb.logs.read",
    "load_vehicle": "crosscomb.models.vehicle",
    "load_artefact": "crosscomb.selection.artefact",
    "estimate_log": "crosscomb.run.estimate",
    "StreamingEstimator": "crosscomb.run.stream",
}


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_PLACES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
