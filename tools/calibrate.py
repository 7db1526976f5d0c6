"""Estimate a camera's calibration from a run, and recommend what makes the half of the recording better that it was not estimated from.

Edges of depth are laid on gradients of colour: registration of the depth camera (focal length, centre, offset), and the delay of depth. Points that
pairs of frames observed give fx and fy against depth, errors of depth that grow with range (`depth_offset`, 1/m, added to inverse depths) and
towards the corners of the image (`depth_radial`), and the readout times of rolling shutters (`readout_s`, `depth_readout_s`). A scale of all depths
is not observable. The gain of a change is the relative decrease of the cost on blocks of frames that were held out, with its standard error over the
blocks; what does not gain significantly is not recommended, nor is a registration that moves depth by less than its edges may be off. Where something
is recommended, the lines for camera.yaml are printed, and --out writes the whole file: run again with it.

Example: trihedron calibrate runs/a/run.mcap --out camera.yaml
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from trihedron.datasets.readers.cameras import NOISES, TIMES, Calibration
from trihedron.datasets.readers.registration import DepthCamera
from trihedron.pipeline.app.calibrated_run import Recommendation
from trihedron.pipeline.core.config import make_plugin
from trihedron.pipeline.core.errors import DataError, TrihedronError, UsageError
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.text_table import table
from trihedron.pipeline.core.types import F64, CalibrationSigmas, Camera, DepthNoise
from trihedron.pipeline.record.reader import Recording
from trihedron.tools import calibration_edges, calibration_pairs
from trihedron.tools.arguments import Parser
from trihedron.tools.calibration_edges import EDGE_BIAS_PX, Edges, block_scores, edges_of, moved_px, register_depth
from trihedron.tools.calibration_judgement import Costs, Judgement, judge
from trihedron.tools.calibration_pairs import Fit, Pairs, fit, scale_of
from trihedron.tools.calibration_recording import Recorded, pairs_of, read_recording

DELAY = (5,)  # of the edges' parameters; always estimated with the others
REGISTRATIONS = ((1, 2), (0, 1, 2), (0, 1, 2, 3, 4))  # sets of the edges' parameters, each a part of the next
READOUTS = {"readout_s": 3, "depth_readout_s": 5}  # of pairs
SHUTTER = (3, 4, 5)  # the same and the delay; always estimated with the others
CHANGES = {"focal lengths": (0,), "depth_offset": (1,), "depth_radial": (2,)}  # of pairs
NONE = Judgement(0.0, float("inf"), 0, False)


@dataclass(frozen=True)
class Estimates:
    """Parameters by edges and by pairs (in the order of their modules' NAMES) as recommended, 0 where not; all, estimated together, with their
    standard deviations; and the judgement of each change by its name."""

    edges: F64
    pairs: F64
    all_edges: tuple[F64, F64]
    all_pairs: tuple[F64, F64]
    judgements: dict[str, Judgement]


def main(argv: list[str]) -> int:
    """Print the estimates; returns the exit code. Raises RecordingError, or DataError for a recording without topics, frames or a camera file."""
    parser = Parser("calibrate", __name__)
    parser.add_argument("recording", metavar="RUN.mcap", type=Path)
    parser.add_argument("--out", metavar="CAMERA.yaml", type=Path, help="write a camera file with what is recommended")
    arguments = parser.parse(argv)
    if arguments.out is not None and not arguments.out.absolute().parent.is_dir():
        raise UsageError("--out", f"the folder {arguments.out.parent} does not exist", "make it first")
    recording = Recording(arguments.recording)
    recorded = read_recording(recording)
    used = calibration_in_use(recording, recorded.camera)
    found = estimate(recorded)
    print(report(found, recorded.camera))
    changed = with_estimates(used, found)
    if changed == used:
        print("no change recommended")
    else:
        print("recommended, in the place of these keys of camera.yaml:\n" + _as_yaml(_changed_keys(used, changed)).rstrip())
    if arguments.out is not None:
        if not used.depth_scale:
            raise DataError(str(recording.path), "is not of a data set with a camera file", "copy the lines that are printed")
        write_file(arguments.out, _as_yaml(keys_of(changed)))
        print(f"written: {arguments.out}" + ("" if changed != used else ", as the camera file in use"))
    return 0


def recommend(recording: Recording) -> Recommendation:
    """Return what is recommended of the recording's camera, as `calibrate=true` applies it. Raises as `main` does."""
    recorded = read_recording(recording)
    used = calibration_in_use(recording, recorded.camera)
    if not used.depth_scale:
        raise DataError(str(recording.path), "is not of a data set with a camera file", "run it without calibrate=true")
    found = estimate(recorded)
    changed = with_estimates(used, found)
    before, after = keys_of(used), _changed_keys(used, changed)
    gains = [(name, one) for name, one in found.judgements.items() if one.recommended]
    changes = [f"{name}: the half that was held out is {100 * one.gain:.1f} ± {100 * one.sigma:.1f} % better" for name, one in gains]
    changes += [f"{key} is {_in_a_line(value)}, was {_in_a_line(before[key]) if key in before else 'not stated'}" for key, value in after.items()]
    return Recommendation(_as_yaml(keys_of(changed)) if changed != used else "", changes)


def _as_yaml(keys: dict[str, Any]) -> str:
    """The keys of a camera file, one a line; lists in their line."""

    def line(key: str, value: Any) -> str:
        nested = isinstance(value, list | dict)
        return str(yaml.safe_dump({key: value}, sort_keys=False, default_flow_style=None if nested else False))

    return "".join(line(key, value) for key, value in keys.items())


def estimate(recorded: Recorded) -> Estimates:
    """Estimate and judge everything."""
    edges = edges_of(recorded.frames, recorded.motions, recorded.blocks)
    judgements: dict[str, Judgement] = {}
    by_edges, all_edges = (
        _by_edges(edges, judgements)
        if len(np.unique(edges.blocks)) > 1
        else (np.zeros(len(calibration_edges.NAMES)), (np.zeros(6), np.full(6, np.inf)))
    )
    depth_camera = _depth_camera(None, recorded.camera, by_edges)
    pairs = pairs_of(recorded, depth_camera)
    nothing = np.zeros(len(calibration_pairs.NAMES))
    by_pairs, all_pairs = (
        _by_pairs(pairs, judgements, bool(by_edges[0])) if pairs is not None else (nothing, (nothing, np.full(len(nothing), np.inf)))
    )
    return Estimates(by_edges, by_pairs, all_edges, all_pairs, judgements)


def _by_edges(edges: Edges, judgements: dict[str, Judgement]) -> tuple[F64, tuple[F64, F64]]:
    """Recommended parameters, and all of them with their standard deviations."""
    halves = [edges.select(edges.blocks % 2 == half) for half in (0, 1)]

    @lru_cache
    def estimate_half(half: int, free: tuple[int, ...]) -> tuple[float, ...]:
        return tuple(register_depth(halves[half], free).parameters) if len(halves[half].pixels) else (0.0,) * 6

    def judge_change(before: tuple[int, ...], after: tuple[int, ...]) -> Judgement:
        def costs(half: int) -> tuple[Costs, Costs]:
            scores = (block_scores(halves[1 - half], np.array(estimate_half(half, free))) for free in (before, after))
            low, high = ({block: -score for block, score in found.items()} for found in scores)
            return low, high

        return judge(costs)

    accepted: tuple[int, ...] = ()
    judgements["registration"] = NONE
    for free in REGISTRATIONS:
        found = judge_change(accepted + DELAY, free + DELAY)
        if found.recommended:
            judgements["registration"], accepted = found if not accepted else judge_change(DELAY, free + DELAY), free
        elif not accepted and found.gain > judgements["registration"].gain:
            judgements["registration"] = found
    judgements["depth_delay_s"] = judge_change(accepted, accepted + DELAY)
    everything = register_depth(edges, REGISTRATIONS[-1] + DELAY)
    chosen = accepted + (DELAY if judgements["depth_delay_s"].recommended else ())
    parameters = register_depth(edges, accepted + DELAY).parameters if accepted else np.zeros(6)
    parameters[5] = parameters[5] if DELAY[0] in chosen else 0.0
    if not accepted and chosen:
        parameters = register_depth(edges, chosen).parameters
    if accepted and moved_px(edges, parameters) < EDGE_BIAS_PX:  # what edges are off must not become a delay, so that it is estimated all the same
        judgements["registration"] = replace(judgements["registration"], recommended=False)
        parameters[:5] = 0.0
    return parameters, (everything.parameters, np.sqrt(np.diag(everything.covariance)))


def _by_pairs(pairs: Pairs, judgements: dict[str, Judgement], has_ratio: bool) -> tuple[F64, tuple[F64, F64]]:
    """Recommended parameters, and all of them with their standard deviations. Where the edges changed the ratio of colour's and depth's focal length
    (`has_ratio`), focal lengths are estimated in any case: edges do not tell which of the two is wrong."""
    scale = scale_of(pairs)
    halves = [pairs.select(pairs.blocks % 2 == half) for half in (0, 1)]
    if not all(len(half.blocks) for half in halves):
        halves = []

    @lru_cache
    def held_out(half: int, free: tuple[int, ...]) -> dict[int, float]:
        parameters = fit(halves[half], free, scale)[0].parameters
        other = halves[1 - half]
        found: Fit = fit(other, (), scale, held=parameters)[0]
        return {int(block): float(found.costs[other.blocks == block].mean()) for block in np.unique(other.blocks)}

    def judge_change(before: tuple[int, ...], after: tuple[int, ...]) -> Judgement:
        return judge(lambda half: (held_out(half, before), held_out(half, after))) if halves else NONE

    accepted: tuple[int, ...] = SHUTTER
    remaining: dict[str, tuple[int, ...]] = dict(CHANGES)
    if has_ratio:
        free = remaining.pop("focal lengths")
        judgements["focal lengths"] = replace(judge_change(accepted, accepted + free), recommended=True)
        accepted += free
    while remaining:
        found = {name: judge_change(accepted, accepted + free) for name, free in remaining.items()}
        judgements.update(found)
        best = max(found, key=lambda name: found[name].gain if found[name].recommended else -np.inf)
        if not found[best].recommended:
            break
        accepted += remaining.pop(best)
    judgements.update({name: judge_change(tuple(k for k in accepted if k != readout), accepted) for name, readout in READOUTS.items()})
    everything = fit(pairs, range(len(calibration_pairs.NAMES)), scale)[0]
    chosen = fit(pairs, accepted, scale)[0].parameters
    recommended = np.where(np.isin(np.arange(len(chosen)), accepted), chosen, 0.0)
    applied = [readout for name, readout in READOUTS.items() if judgements[name].recommended]
    recommended[np.setdiff1d(SHUTTER, applied)] = 0.0
    return recommended, (everything.parameters, np.sqrt(np.diag(everything.covariance)))


def report(found: Estimates, camera: Camera) -> str:
    """Make the table of estimates; pixels are those of the image."""
    px = camera.width / 640.0
    (edges, edge_sigmas), (pairs, pair_sigmas) = found.all_edges, found.all_pairs
    rows = [["figure", "estimate", "standard deviation", "gain", "its error", "recommended"]]

    def row(label: str, value: float, sigma: float, name: str, decimals: int) -> None:
        verdict = found.judgements.get(name, NONE)
        known = bool(np.isfinite(sigma))
        cells = [f"{value:.{decimals}f}", f"{sigma:.{decimals}f}"] if known else ["-", "-"]
        gain = [f"{100 * verdict.gain:.1f} %", f"{100 * verdict.sigma:.1f} %"] if np.isfinite(verdict.sigma) else ["-", "-"]
        rows.append([label, *cells, *gain, "yes" if verdict.recommended else "no"])

    row("colour focal length / depth focal length", float(np.exp(edges[0])), float(edge_sigmas[0]), "registration", 4)
    for k, axis in ((1, "x"), (2, "y")):
        row(f"shift of depth in {axis} (px)", edges[k] * px, edge_sigmas[k] * px, "registration", 2)
    for k, axis in ((3, "x"), (4, "y")):
        row(f"offset of depth in {axis} (mm)", 1e3 * edges[k], 1e3 * edge_sigmas[k], "registration", 1)
    row("depth_delay_s (added to that in use)", edges[5], edge_sigmas[5], "depth_delay_s", 4)
    factor = float(np.exp(pairs[0]))
    row(f"fx (px; {camera.fx:g} in use, fy alike)", camera.fx * factor, camera.fx * factor * float(pair_sigmas[0]), "focal lengths", 2)
    row("depth_offset (1/m)", float(pairs[1]), float(pair_sigmas[1]), "depth_offset", 5)
    row("depth_radial", float(pairs[2]), float(pair_sigmas[2]), "depth_radial", 4)
    row("readout_s (added to that in use)", float(pairs[3]), float(pair_sigmas[3]), "readout_s", 4)
    row("depth_readout_s (added to that in use)", float(pairs[5]), float(pair_sigmas[5]), "depth_readout_s", 4)
    return table(rows, "lrrrrr")


def calibration_in_use(recording: Recording, camera: Camera) -> Calibration:
    """The calibration of the recording's data set; of one without a camera file the frames' camera, with the depth scale 0."""
    from trihedron.pipeline.app.recorded_run import composed_run

    options = composed_run(recording).dataset
    data_set: Any = make_plugin("dataset", options) if "camera" in options else None
    if not hasattr(data_set, "calibration"):
        return Calibration(camera, 0.0)
    try:
        found: Calibration = data_set.calibration()
    except (TrihedronError, OSError):  # it is not there any more
        return Calibration(camera, 0.0)
    return found if (found.camera.width, found.camera.fx) == (camera.width, camera.fx) else Calibration(camera, 0.0)


def with_estimates(used: Calibration, found: Estimates) -> Calibration:
    """The calibration with what is recommended."""
    camera = used.camera
    depth_camera = _depth_camera(used.depth_camera, camera, found.edges)
    factor = float(np.exp(found.pairs[0]))
    if depth_camera is not None:  # the same pixels belong together under other focal lengths
        x, y, z = depth_camera.translation_m
        fx, fy = depth_camera.fx * factor, depth_camera.fy * factor
        depth_camera = replace(depth_camera, fx=fx, fy=fy, translation_m=(x / factor, y / factor, z))
    camera = replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)
    offset, radial = used.depth_offset + float(found.pairs[1]), used.depth_radial + float(found.pairs[2])
    times = {name: getattr(used, name) + float(found.pairs[k]) for name, k in READOUTS.items()}
    times["depth_delay_s"] = used.depth_delay_s + float(found.edges[5])
    return replace(used, camera=camera, depth_camera=depth_camera, depth_offset=offset, depth_radial=radial, **times)


def _depth_camera(used: DepthCamera | None, camera: Camera, edges: F64) -> DepthCamera | None:
    """The depth camera whose registered images lie where the edges' parameters move those of the camera in use."""
    if not edges[:5].any():
        return used
    given = used if used is not None else DepthCamera(camera.fx, camera.fy, camera.cx, camera.cy)
    scale, (shift_x, shift_y), (x, y, z) = float(np.exp(edges[0])), edges[1:3] * camera.width / 640.0, given.translation_m
    fx, fy = given.fx / scale, given.fy / scale
    translation = scale * x + float(edges[3]), scale * y + float(edges[4]), z
    return replace(given, fx=fx, fy=fy, cx=given.cx - float(shift_x) * fx / camera.fx, cy=given.cy - float(shift_y) * fy / camera.fy,
                   translation_m=translation)  # fmt: skip


def keys_of(calibration: Calibration) -> dict[str, Any]:
    """The keys of a camera file, rounded to what matters."""
    camera, given = calibration.camera, calibration.depth_camera
    keys: dict[str, Any] = {"width": camera.width, "height": camera.height}
    keys |= {name: round(float(getattr(camera, name)), 3) for name in ("fx", "fy", "cx", "cy")}
    keys |= {"depth_scale": calibration.depth_scale, "fps": camera.fps}
    keys |= {"distortion": list(calibration.distortion)} if calibration.distortion else {}
    keys |= {name: round(value, 6) for name in ("depth_offset", "depth_radial") if (value := getattr(calibration, name))}
    keys |= {name: round(getattr(calibration, name), 4) for name in TIMES}  # 0 too: of the benchmark's cameras it is not what is assumed
    if camera.depth_noise != DepthNoise():
        names = {noise: name for name, noise in NOISES.items()}
        keys["depth_noise"] = names.get(camera.depth_noise) or asdict(camera.depth_noise)
    usual = asdict(CalibrationSigmas())
    if sigmas := {name: value for name, value in asdict(camera.sigmas).items() if value != usual[name]}:
        keys["sigmas"] = sigmas
    if given is not None:
        own: dict[str, Any] = {name: round(float(getattr(given, name)), 3) for name in ("fx", "fy", "cx", "cy")}
        keys["depth_camera"] = own | {
            name: _round_each(getattr(given, name)) for name in ("translation_m", "rotation_deg") if any(getattr(given, name))
        }
    return keys


def _round_each(values: Sequence[float]) -> list[float]:
    return [round(float(value), 5) for value in values]


def _in_a_line(value: Any) -> str:
    """A value of a camera file."""
    return str(yaml.safe_dump(value, sort_keys=False, default_flow_style=True, width=1000)).removesuffix("\n...\n").rstrip()


def _changed_keys(used: Calibration, changed: Calibration) -> dict[str, Any]:
    before, after = keys_of(used), keys_of(changed)
    return {name: value for name, value in after.items() if before.get(name) != value}
