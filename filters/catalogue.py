"""Every estimator by its name: one line each, and how it is made from settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from importlib import import_module
from typing import Any

from crosscomb.checked import LARGEST
from crosscomb.errors import UsageError, shown
from crosscomb.filters.base import KernelFilter
from crosscomb.models.vehicle import Vehicle


@dataclass(frozen=True)
class Entry:
    """One line of the catalogue."""

    place: str
    """Module in `crosscomb.filters` and class in it, as ``module:Class``; a run imports only what it makes."""
    summary: str
    source: str

    def load(self) -> type[KernelFilter]:
        """Import the estimator's class."""
        module, _, name = self.place.partition(":")
        loaded: type[KernelFilter] = getattr(import_module(f"crosscomb.filters.{module}"), name)
        return loaded


CATALOGUE: dict[str, Entry] = {
    "kinematic_kf": Entry(
        "kinematic.kf:KinematicKF",
        "Kalman filter that integrates the accelerometers and learns their offsets; right in slides, coarse elsewhere",
        "Atheupe 2023, eq. 18 to 21; Ryu and Gerdes 2004",
    ),
    "dynamic_ekf": Entry(
        "single_track.ekf:DynamicEKF",
        "extended Kalman filter on the single track with Dugoff tyres; right while the friction is",
        "Atheupe 2023, eq. 22 to 25",
    ),
    "random_walk_pf": Entry(
        "random_walk.pf:RandomWalkPF",
        "particle filter with free axle forces, softly tied to the EKF; needs no friction, follows the EKF",
        "Atheupe 2023, eq. 17 and 29; Schoen, Gustafsson and Nordlund 2005",
    ),
    "lint_ekf": Entry(
        "single_track.tyre_ekf:LINT",
        "EKF that adapts the cornering stiffness of both axles in turns; follows wear and wet, lost in slides",
        "Di Biase 2020, eq. 21 to 45, corrected",
    ),
    "ratt_ekf": Entry(
        "single_track.tyre_ekf:RATT",
        "EKF with slip and yaw rates as states on fixed rational tyres; right while the friction is",
        "Di Biase 2020, eq. 46 to 52, Jacobians derived anew",
    ),
    "ratte_ekf": Entry(
        "single_track.tyre_ekf:RATTE",
        "EKF that adapts rational tyres in turns; follows the grip, misled by bank and speed errors",
        "Di Biase 2020, eq. 53 to 60, Jacobians derived anew",
    ),
    "dual_ekf": Entry(
        "single_track.dual_ekf:DualEKF",
        "two EKFs, one for the motion, one for rational tyres; adapts more slowly than ratte_ekf",
        "Ahangarnejad and Baslamisli 2016, as cited in Di Biase 2020 [22]",
    ),
    "friction_adaptive_ekf": Entry(
        "single_track.friction_ekf:FrictionAdaptiveEKF",
        "EKF on Dugoff tyres that learns the friction in hard turns; blind to it in gentle driving",
        "Chindamo 2018, section 2; Atheupe 2023, eq. 22, 23, 30",
    ),
    "random_walk_ekf": Entry(
        "random_walk.ekf:RandomWalkEKF",
        "EKF with free axle forces, softly tied to a linear rear tyre; needs no friction, fails in slides",
        "Atheupe 2023, eq. 29, corrected",
    ),
    "double_track_random_walk_ekf": Entry(
        "random_walk.double_track_ekf:DoubleTrackRandomWalkEKF",
        "EKF with free wheel forces on the double track, for slow manoeuvres; fails in slides",
        "Pieralice 2018, section 3, EKF+RW",
    ),
    "adaptive_pf": Entry(
        "random_walk.adaptive_pf:AdaptivePF",
        "random-walk particle filter that takes more particles where few fit; follows the EKF in the long run",
        "Atheupe 2023, section 7.3",
    ),
    "kinematic_pf": Entry(
        "kinematic.pf:KinematicPF",
        "particle filter that integrates the accelerometers; no better than the Kalman filter of the same model",
        "Atheupe 2023, eq. 18 to 21 and section 7.2",
    ),
    "dynamic_pf": Entry(
        "single_track.pf:DynamicPF",
        "particle filter on the single track with Dugoff tyres; right while the friction is, slow",
        "Atheupe 2023, eq. 22 to 25; D'Inverno 2021, section 2.2",
    ),
    "first_order_ekf": Entry(
        "planar.ekf:FirstOrderEKF",
        "EKF for u, v and yaw rate with Magic Formula tyres on the single track; right while the friction is",
        "D'Inverno 2021, algorithm 1",
    ),
    "double_track_ekf": Entry(
        "planar.ekf:DoubleTrackEKF",
        "first_order_ekf with four wheels and lateral load transfer; right while the friction is",
        "Pieralice 2018, eq. 1 to 6",
    ),
    "iterated_ekf": Entry(
        "planar.ekf:IteratedEKF",
        "first_order_ekf with the update repeated to the most likely state; no better where the tyre law is wrong",
        "D'Inverno 2021, algorithm 2, corrected",
    ),
    "second_order_ekf": Entry(
        "planar.second_order_ekf:SecondOrderEKF",
        "first_order_ekf with the curvature of the tyre law; overstates it beyond the peak of the tyre",
        "D'Inverno 2021, algorithm 3, corrected after Simon 2006",
    ),
    "simple_ukf": Entry(
        "planar.ukf:SimpleUKF",
        "unscented filter of first_order_ekf's model, six points; may leave a spin on the wrong side",
        "D'Inverno 2021, algorithm 4, corrected",
    ),
    "general_ukf": Entry(
        "planar.ukf:GeneralUKF",
        "unscented filter with a centre point and free spread; a wide spread reaches beyond the tyre's peak",
        "D'Inverno 2021, eq. 2",
    ),
    "simplex_ukf": Entry(
        "planar.ukf:SimplexUKF",
        "unscented filter with five points, lopsided and so less exact; cheapest of the four with spherical_ukf",
        "D'Inverno 2021, algorithm 6",
    ),
    "spherical_ukf": Entry(
        "planar.ukf:SphericalUKF",
        "unscented filter with five points on a sphere; fails where simple_ukf does",
        "D'Inverno 2021, algorithm 5",
    ),
    "sqrt_cubature_kf": Entry(
        "planar.ckf:SqrtCubatureKF",
        "cubature filter that carries the root of the covariance; simple_ukf without its rounding errors",
        "Chindamo 2018, section 2.2; Arasaratnam and Haykin 2009",
    ),
    "cubature_receding_horizon_kf": Entry(
        "planar.ckf:CubatureRecedingHorizonKF",
        "cubature filter that forgets all but the last 0.3 s; sheds old errors, loses long slides, slow",
        "Chindamo 2018, section 2.2",
    ),
    "cubature_hybrid_kf": Entry(
        "planar.ckf:CubatureHybridKF",
        "both cubature filters weighed by likelihood; between the two, slow",
        "Chindamo 2018, section 2.2",
    ),
    "kinematic_kf_zero_yaw": Entry(
        "kinematic.kf_variants:ZeroYawKF",
        "kinematic filter that measures the steady slip near zero yaw rate; wrong when the car slides straight on",
        "Chindamo 2018, section 2.2 (Farrelly)",
    ),
    "kinematic_blend_kf": Entry(
        "kinematic.kf_variants:BlendKF",
        "kinematic filter on the tyres' forces near zero yaw rate; wrong when the car slides straight on",
        "Chindamo 2018, section 2.2 (Ungoren)",
    ),
    "luenberger": Entry(
        "single_track.observers:Luenberger",
        "observer on the linear single track, poles placed over speed; right while the tyres are linear",
        "Chindamo 2018, section 2",
    ),
    "extended_luenberger": Entry(
        "single_track.observers:ExtendedLuenberger",
        "observer on the nonlinear single track, poles placed at each step; right while the friction is",
        "Chindamo 2018, section 2; Ding et al. 2014",
    ),
    "sliding_mode": Entry(
        "single_track.observers:SlidingMode",
        "first-order sliding mode on the nonlinear single track; bounded pull, right while the friction is",
        "Chindamo 2018, section 2",
    ),
    "gnss_kinematic_kf": Entry(
        "kinematic.gnss_kf:GnssKinematicKF",
        "kinematic filter that learns sensor errors from GNSS; needs two antennas for slides, drifts without fixes",
        "Chindamo 2018, section 2.3 (Bevly, Ryu)",
    ),
    "gnss_dynamic_observer": Entry(
        "single_track.gnss_ekf:GnssDynamicObserver",
        "dynamic EKF corrected by GNSS course minus heading; without fixes right while the friction is",
        "Chindamo 2018, section 2.3 and table 1",
    ),
    "fuzzy_blend": Entry(
        "combined.blends:FuzzyBlend",
        "dynamic in steady states, kinematic in transients, by a fuzzy index; fails in long slides",
        "Chindamo 2018, section 2.2 (Cheli)",
    ),
    "cross_combined_ukf": Entry(
        "combined.cross_combined:CrossCombinedUKF",
        "kinematic in turns, unscented dynamic on straights; fails in slides with little yaw rate",
        "Atheupe 2023, section 1 (Villano)",
    ),
    "covariance_fusion": Entry(
        "combined.blends:CovarianceFusion",
        "kinematic and dynamic filter weighted by their variances; as wrong as the surer of the two",
        "Julier and Uhlmann 1997",
    ),
    "imm": Entry(
        "combined.multiple_model:IMM",
        "mixes dynamic models on two frictions and the kinematic one by likelihood; slow to tell them apart",
        "Atheupe 2023, section 2 [63]; Blom and Bar-Shalom 1988",
    ),
    "mmae": Entry(
        "combined.multiple_model:MMAE",
        "the same three models, each on its own, weighted by likelihood; noisier in normal driving",
        "Atheupe 2023, section 2 [67]; Magill 1965",
    ),
    "network": Entry(
        "learned:NeuralNetwork",
        "neural network on ay, yaw rate, steer and speed; right for cars and roads like those it was trained on",
        "Chindamo 2018, section 3",
    ),
    "network_feedback": Entry(
        "learned:FeedbackNetwork",
        "network that also sees its own answer of 0.08 s ago; smoother, fails on cars and roads it does not know",
        "Chindamo 2018, section 3 (Melzi)",
    ),
}

RENAMED = {"rao_blackwell_pf": "random_walk_pf"}
"""Names of before; to run the filter under its new one needs no settings."""

LEAST_DIVISOR = 1e-9
MOST_PARTICLES = 1_000_000
MOST_SEED = 2**63 - 1

DEFAULT_FILTERS = ("kinematic_kf", "dynamic_ekf", "random_walk_pf")


def make_filter(name: str, vehicle: Vehicle, settings: Mapping[str, Any] | None = None) -> KernelFilter:
    """Make an estimator of the catalogue for one vehicle.

    Parameters
    ----------
    name : str
        Key of `CATALOGUE`.
    vehicle : Vehicle
    settings : mapping, optional
        As `settings_of` gives them; what is left out keeps its default.

    Raises
    ------
    UsageError
        The name or a setting is unknown, or a value is out of range.
    """
    require_listed(f"filter {name}", name)
    cls = CATALOGUE[name].load()
    defaults = {f.name: f.default for f in fields(cls) if f.name != "vehicle"}
    given, chosen = dict(settings or {}), {}
    for key, others in cls.implied.items():
        if key in given:
            given = {**others, **given}
    for key, value in given.items():
        if key not in defaults:
            raise UsageError(f"filter {name}: unknown setting {key}: take of {', '.join(defaults)}")
        where, check = f"filter {name}: {key}", cls.tables.get(key)
        chosen[key] = check(where, value) if check else _checked(where, key, value, defaults[key], cls)
    return cls(vehicle, **chosen)


def require_listed(where: str, name: str) -> None:
    """Refuse a name that is not in the catalogue; of a filter that has another name now, say which.

    Raises
    ------
    UsageError
    """
    if name in RENAMED:
        raise UsageError(f"{where}: is what {RENAMED[name]} runs by default now: name that instead")
    if name not in CATALOGUE:
        raise UsageError(f"{where}: not in the catalogue: `crosscomb filters` lists what there is")


def settings_of(estimator: KernelFilter) -> dict[str, Any]:
    """Settings of an estimator as plain numbers and words, for a JSON file."""
    values = {f.name: getattr(estimator, f.name) for f in fields(estimator) if f.name != "vehicle"}
    return {key: _plain(value) for key, value in values.items()}


def _plain(value: Any) -> Any:
    if hasattr(value, "_asdict"):
        return {key: _plain(part) for key, part in value._asdict().items()}
    if isinstance(value, tuple):
        return [_plain(part) for part in value]
    return value


def _checked(where: str, key: str, value: Any, default: Any, cls: type[KernelFilter]) -> Any:
    """Check a setting against the kind of its default and give it that kind."""
    if hasattr(default, "_asdict"):
        return _checked_noise(where, value, default, cls)
    if isinstance(default, str):
        words = cls.choices.get(key, ())
        if value not in words:
            raise UsageError(f"{where}: {shown(value)} is unknown: take one of {', '.join(words)}")
        return value
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise UsageError(f"{where}: {shown(value)} is no number")
    if isinstance(default, int):
        least, most = (0, MOST_SEED) if key == "seed" else (1, MOST_PARTICLES)
        if not least <= value <= most or int(value) != value:
            raise UsageError(f"{where}: {shown(value)} must be a whole number from {least} to {most}")
        return int(value)
    if not 0.0 <= value <= LARGEST:
        raise UsageError(f"{where}: {shown(value)} must be finite and not negative")
    if key in cls.divisors and value < LEAST_DIVISOR:
        raise UsageError(f"{where}: {value!r} must be at least {LEAST_DIVISOR:g}: the filter divides by it")
    return float(value)


def _checked_noise(where: str, value: Any, default: Any, cls: type[KernelFilter]) -> Any:
    if not isinstance(value, Mapping):
        raise UsageError(f"{where}: must be a table of {', '.join(default._fields)}")
    for key in value:
        if key not in default._fields:
            raise UsageError(f"{where}: unknown setting {key}: take of {', '.join(default._fields)}")
    return default._replace(
        **{
            key: _checked(f"{where}.{key}", key, part, getattr(default, key), cls)
            for key, part in value.items()
        }
    )
