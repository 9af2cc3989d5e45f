"""Identification on real logs: found against documented, and what it brings the dynamic EKF.

Run with ``python benchmarks/identify_real.py ../shared/data [--tuned]``. The logs are read as they are: no channel
map, and a vehicle file whose steering ratio is wrong where the documented one is sought. The second table tests each
recording of the set with car and sensors as identified on the same car's other recordings, with their ground truth,
or, where there are none, on the recording itself without its ground truth. With ``--tuned`` a third table adds noise
tuned on the eleven other recordings, whose cars are then identified without the one that is judged.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from crosscomb.logs.read import read_log
from crosscomb.models.vehicle import load_vehicle
from crosscomb.selection.artefact import load_artefact
from crosscomb.training.identification.files import identified_recording
from crosscomb.training.identification.identify import identify
from crosscomb.training.identification.sensors import still_biases
from crosscomb.training.recordings import Recording, find_logs, read_recordings
from crosscomb.training.selectors.bank import run_one
from crosscomb.training.selectors.train import RATE, default_filters
from crosscomb.training.tuning.scores import ERROR, prepare, score_logs
from crosscomb.training.tuning.tune import tune

REAL_SET = {
    "kth_volvo_s90": ("slalom_30kph", "stepsteer_left_100kph"),
    "kth_volvo_v40": ("slalom_35kph", "sine_with_dwell_80kph"),
    "revs_ferrari_250lm": ("targa66_20140222_01_part1",),
    "stanford_gti_2018": ("oval_aa", "oval_ab", "oval_ad"),
    "stanford_gti_2019": ("high_speed_1", "low_speed", "double_lane_change_1", "double_lane_change_2"),
}
DIVERGED = np.radians(30.0)
"""No recording of the set has a larger sideslip angle: an estimate beyond has run away."""


def documented(data: Path) -> None:
    """What the logs' README says against what is found."""
    logs = [read_log(path) for path in find_logs(data / "kth_volvo_s90")]
    car = load_vehicle("volvo_s90").model_copy(update={"steering_ratio": 25.0})
    rows = []
    for use, word in ((True, "with truth"), (False, "without truth")):
        result = identify(logs, car, use)
        ratio, ay = result.judgements["steering_ratio"], result.judgements["ay_bias"]
        rows.append(
            (f"S90 steering ratio, {word}", ratio.after, "15.6", f"{ratio.low:.2f} to {ratio.high:.2f}")
        )
        # The accelerometer's offset on the road, body lean of the parked car excluded: README's ay - kin means.
        rows.append(
            (
                f"S90 ay offset driving [m/s^2], {word}",
                ay.after,
                "0.14 to 0.21",
                f"{ay.low:.3f} to {ay.high:.3f}",
            )
        )
        if result.kinematics is not None:
            delay, std = result.kinematics.yaw_delay
            rows.append(
                ("S90 yaw-rate latency [s], behind the truth", delay, "0.040", f"+- {1.96 * std:.3f}")
            )
            delay, std = result.kinematics.ay_delay
            rows.append(
                ("S90 ay latency [s], behind the truth", delay, "0.010 to 0.030", f"+- {1.96 * std:.3f}")
            )
    still = still_biases(logs)[0]
    rows.append(("S90 ay offset at standstill [m/s^2]", still["ay"][0], "-0.068", ""))
    rows.append(("S90 yaw-rate offset at standstill [rad/s]", still["yaw_rate"][0], "-0.0017", ""))
    logs = [read_log(path) for path in find_logs(data / "stanford_audi_tts_2011")]
    for use, word in ((True, "with truth"), (False, "without truth")):
        place = identify(logs, load_vehicle("audi_tts"), use).judgements["position"]
        rows.append(
            (f"Audi accelerometer [m], {word}", place.after, "-1.42", f"{place.low:.2f} to {place.high:.2f}")
        )
    for name, value, said, spread in rows:
        print(f"{name:50s} found {value:9.4f}  documented {said:15s} {spread}", flush=True)


def score(recording: Recording) -> dict[str, tuple[float, bool]]:
    """RMSE [deg] of each filter of the shipped artefact, and whether it ran away."""
    artefact = load_artefact()
    run = run_one(recording, artefact.filters, artefact.rate, artefact.window)
    beta = run.joined(lambda part: part.beta)[run.counted]
    error = np.degrees(beta - run.beta_ref[run.counted][:, None])
    rmse, away = np.sqrt(np.mean(error**2, axis=0)), np.max(np.abs(beta), axis=0) > DIVERGED
    return {name: (float(e), bool(a)) for name, e, a in zip(artefact.filter_names, rmse, away, strict=True)}


def joint(data: Path) -> None:
    """The filters with the default and with the identified car on each recording."""
    filters = load_artefact().filter_names
    print("\nRMSE [deg], default and identified; * ran away")
    print(f"{'recording':42s} " + " ".join(f"{name:>19s}" for name in filters))
    table = []
    for folder, names in REAL_SET.items():
        found, _ = read_recordings(data / folder)
        recordings = [one for one in found if one.name in names]
        for recording in recordings:
            others = [one for one in recordings if one is not recording]
            before, after = score(recording), score(identified_recording(recording, others))
            table.append([[one[name][0] for name in filters] for one in (before, after)])
            cells = [
                " ".join(f"{one[name][0]:.2f}{'*' if one[name][1] else ' '}" for one in (before, after))
                for name in filters
            ]
            print(f"{recording.name:42s} " + " ".join(f"{cell:>19s}" for cell in cells), flush=True)
    before_mean, after_mean = np.mean(table, axis=0)
    for name, old, new in zip(filters, before_mean, after_mean, strict=True):
        print(f"mean of {name}: {old:.3f} to {new:.3f}, change {new / old - 1.0:+.1%}")


def tuned_and_identified(data: Path, evaluations: int, name: str = "dynamic_ekf") -> None:
    """One filter with the default, and with noise tuned and cars identified without the recording that is judged."""
    cars = {
        folder: [one for one in read_recordings(data / folder)[0] if one.name in names]
        for folder, names in REAL_SET.items()
    }
    pairs = [(folder, one) for folder, own in cars.items() for one in own]
    entry = default_filters(pairs[0][1].vehicle, [name])[0]
    print(f"\nRMSE [deg] of {name}: default, identified, tuned and identified")
    table = []
    for held_folder, held in pairs:
        seen = []
        for folder, one in pairs:
            # The judged recording lends its ground truth to nothing, its own car included.
            others = [other for other in cars[folder] if other is not one and other is not held]
            seen.append(identified_recording(one, others))
        judged = seen.pop([one for _, one in pairs].index(held))
        kept = tune(seen, [entry], RATE, ERROR, evaluations).filters[0].kept
        row = [score_logs(*pair, ERROR)[0] for pair in (
            (entry, prepare([held], RATE)), (entry, prepare([judged], RATE)), (kept, prepare([judged], RATE)),
        )]  # fmt: skip
        table.append(row)
        words = "" if kept != entry else "  (default noise kept)"
        print(f"{held_folder}/{held.name:32s} " + " ".join(f"{x:6.2f}" for x in row) + words, flush=True)
    default, identified, both = np.mean(table, axis=0)
    print(f"mean {default:.3f}, {identified:.3f} ({identified / default - 1.0:+.1%}), "
          f"{both:.3f} ({both / default - 1.0:+.1%}); largest {np.max(table, axis=0).round(2)}")  # fmt: skip


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--tuned", action="store_true", help="the third table, which takes long")
    parser.add_argument("--evaluations", type=int, default=50, help="of each search of the tuning")
    options = parser.parse_args()
    documented(options.folder)
    joint(options.folder)
    if options.tuned:
        tuned_and_identified(options.folder, options.evaluations)


if __name__ == "__main__":
    main()
