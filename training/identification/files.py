"""What identification leaves behind: the fitted vehicle file, the channel map beside it, the table."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import replace
from math import isfinite

import numpy as np

from crosscomb.errors import UsageError
from crosscomb.logs.channel_map import Accelerometer, Channel, ChannelMap, apply_map
from crosscomb.logs.prepare import complete
from crosscomb.models.vehicle import vehicle_text
from crosscomb.signals import REFERENCES
from crosscomb.training.identification.handling import shown_motion
from crosscomb.training.identification.identify import Identification, identify
from crosscomb.training.identification.judgements import SAID, Judgement
from crosscomb.training.identification.parameters import IN_VEHICLE
from crosscomb.training.identification.trace import settled
from crosscomb.training.recordings import Recording

HEADER = ("parameter", "unit", "before", "after", "low_95", "high_95", "word")


def fitted_text(result: Identification) -> str:
    """Text of the fitted vehicle file; what was found has its interval behind it."""
    remarks = {
        name: f"identified: {interval(one)} (95 %), before {one.before:.6g}"
        for name, one in result.judgements.items()
        if one.taken and (name in IN_VEHICLE or name == "tyre.shape")
    }
    return vehicle_text(result.vehicle, remarks)


def fitted_map(result: Identification, base: ChannelMap | None = None) -> ChannelMap:
    """The channel map that takes out of the logs what was found of the sensors.

    Parameters
    ----------
    result : Identification
    base : ChannelMap, optional
        The map that the logs were read with. The new one contains it.
    """
    base = base or ChannelMap()
    channels = dict(base.channels)
    found = {name: one.after for name, one in result.judgements.items() if one.taken}
    for name, bias in (("yaw_rate", "yaw_bias"), ("ay", "ay_bias"), ("ax", "ax_bias")):
        if bias in found:
            old = channels.get(name, Channel())
            channels[name] = old.model_copy(update={"offset": old.offset + found[bias]})
    steer = _steering(result, channels, found)
    # References share a delay; steering has none of its own here.
    delays = {"yaw_rate": "yaw_delay", "ay": "ay_delay", **dict.fromkeys(_references(result), "beta_delay")}
    late = {name: found[delay] for name, delay in delays.items() if delay in found} | {steer: 0.0}
    earliest = min(late.values())
    for name, delay in late.items():
        if delay - earliest > 0.0 or name in channels:
            old = channels.get(name, Channel())
            channels[name] = old.model_copy(update={"delay": min(old.delay + delay - earliest, 1.0)})
    place = base.accelerometer
    if "position" in found:
        x, y = place.position if place else (0.0, 0.0)
        place = Accelerometer(position=(x + found["position"], y))
    return ChannelMap(channels=channels, accelerometer=place, reader=base.reader)


def identified_recording(recording: Recording, others: Sequence[Recording]) -> Recording:
    """A recording with the car and the sensors as identified on other recordings of the same car.

    Where there are none, on the recording itself without its ground truth; unchanged where nothing can be found.

    Parameters
    ----------
    recording : Recording
    others : sequence of Recording
        Their ground truth is used.
    """
    try:
        logs = [one.signals for one in others or [recording]]
        result = identify(logs, recording.vehicle, use_reference=bool(others))
    except UsageError:
        return recording
    found = fitted_map(result)
    # A column that this log does not have needs no correction.
    frame = recording.signals.frame
    named = {name: one for name, one in found.channels.items() if (one.column or name) in frame}
    found = found.model_copy(update={"channels": named})
    signals = apply_map(frame, found, recording.signals.name, recording.signals.source)
    return replace(recording, vehicle=result.vehicle, held=complete(signals, result.vehicle))


def _steering(result: Identification, channels: dict[str, Channel], found: dict[str, float]) -> str:
    """Put the steering offset into the map; gives the channel that steering is read from."""
    offset = found.get("steer_offset", 0.0)
    if not result.ratio_open:
        old = channels.get("steer", Channel())
        scale = found.get("steer_scale", 1.0)
        channels["steer"] = old.model_copy(
            update={"scale": old.scale / scale, "offset": old.offset / scale + offset}
        )
        return "steer"
    # A column steer made with the old ratio would win over the hand wheel: the new one takes its place.
    ratio = result.vehicle.steering_ratio
    wheel = channels.pop("steer_wheel", Channel())
    column, scale = wheel.column or "steer_wheel", wheel.scale / ratio
    update = {"column": column, "scale": scale, "offset": wheel.offset / ratio + offset}
    channels["steer"] = wheel.model_copy(update=update)
    return "steer"


def _references(result: Identification) -> list[str]:
    """Columns of ground truth that the logs have."""
    return [name for name in REFERENCES if name in result.references]


def map_text(channel_map: ChannelMap) -> str:
    """A channel map as the text of its file."""
    content = channel_map.model_dump(exclude_defaults=True)
    lines = ["# Written by `crosscomb identify`; holds the channel map that the logs were read with, too."]
    if "reader" in content:
        lines += ["", "[reader]", *_lines(content["reader"])]
    for name, channel in content.get("channels", {}).items():
        lines += ["", f"[channels.{name}]", *_lines(channel)]
    if "accelerometer" in content:
        lines += ["", "[accelerometer]", *_lines(content["accelerometer"])]
    return "\n".join(lines) + "\n"


def _lines(values: dict[str, object]) -> list[str]:
    # A JSON string, number, list or truth value is a valid TOML one.
    return [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in values.items()]


def table_rows(result: Identification) -> list[list[str]]:
    """The judgements as text, one row each, with the columns of `HEADER`."""
    return [
        [SAID.get(name, name), one.unit, *map(_short, (one.before, one.after, one.low, one.high)), one.word]
        for name, one in result.judgements.items()
    ]


def _short(value: float) -> str:
    """A number for people; nothing where there is none."""
    return f"{value:.6g}" if isfinite(value) else ""


def table_csv(result: Identification) -> str:
    """The judgements as CSV under the names that programs know them by."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(HEADER)
    for name, row in zip(result.judgements, table_rows(result), strict=True):
        writer.writerow([name, *row[1:]])
    return stream.getvalue()


def interval(one: Judgement) -> str:
    """The interval in words."""
    return f"{one.low:.6g} to {one.high:.6g}"


def rms(values: np.ndarray) -> float:
    """Root of the mean square of what is finite; NaN where nothing is."""
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def motion_rows(result: Identification) -> list[list[str]]:
    """For each log: what is left of yaw rate [rad/s] and ay [m/s^2] against the model, before and after (rms)."""
    rows = []
    for i, trace in enumerate(result.problem.traces):
        cells, counted = [trace.name], settled(trace.normal)
        for output, measured in enumerate((trace.yaw_rate, trace.ay)):
            for fit in (result.first, result.fit):
                miss = shown_motion(result.problem, fit, i)[output] - measured
                cells.append(_short(rms(miss[counted])))
        rows.append(cells)
    return rows
