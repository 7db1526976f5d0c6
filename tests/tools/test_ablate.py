"""Ablations of recordings: what is computed, what each swap changes, and mistakes in one line."""

import json
import os
import re
import sys
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import cv2
import html5lib
import numpy as np
import pytest

from trihedron.comparison.ablation import options_of
from trihedron.comparison.ablation_tables import (
    Case,
    Variant,
    alternatives_table,
    as_json,
    as_markdown,
    as_text,
    attribution,
    attribution_table,
    case_from_dict,
    case_to_dict,
    cost_table,
    lines_of,
    sections_of,
    verdicts,
)
from trihedron.comparison.frame_errors import read_errors, write_errors
from trihedron.comparison.partings import Parting, StageErrors, changed_by_code, distance
from trihedron.comparison.swaps import combinations_of, folder_name, parse_swaps, single_swaps
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.errors import DataError, UsageError
from trihedron.pipeline.core.slots import SLOTS
from trihedron.pipeline.core.types import ManhattanFrame, Translation
from trihedron.pipeline.record.reader import Recording
from trihedron.tools.site import write_site
from trihedron.tools.site_ablations import ablation_page, ablations_of, attribution_bars, charts_of

sys.path.insert(0, str(Path(__file__).parent))
from faulty_plugins import faulty

__all__ = ["faulty"]  # a fixture

OF_FRAMES = "Differences; ± half the 95 % interval from the frames of one recording, where a figure is a mean over frames"
SMALL = ["dataset.width=320", "dataset.height=240", "threads=1"]


def case(number, figures, stages=("manhattan", "rotation")):
    """Alternatives of one recording: all combinations of one change a stage, with these ATE."""
    combinations = combinations_of(parse_swaps([f"{stage}=other" for stage in stages]))
    variants = [Variant(one, f"{number}/{one.label}", {"ATE mm": ate, "ms": 1.0}, 1.0, 1.1) for one, ate in zip(combinations, figures)]
    return Case(f"{number}/run.mcap", 10, list(stages), [], np.nan, 4.4, variants)


def test_swaps_are_combined_by_stage():
    swaps = parse_swaps(["planes.angle_deg=2,3", "planes.min_points=100", "manhattan=mean_shift,plane_svd", "graph.tracks.manhattan=manhattan@prev"])
    assert [(swap.stage, len(swap.levels)) for swap in swaps] == [("planes", 6), ("manhattan", 3), ("tracks", 2)]
    combinations = combinations_of(swaps)
    assert len(combinations) == 36 and combinations[0].label == "as recorded" and combinations[0].stages == frozenset()
    assert combinations[-1].words == ("planes.angle_deg=3", "planes.min_points=100", "manhattan=plane_svd", "graph.tracks.manhattan=manhattan@prev")
    name = folder_name("desk", combinations[-1])
    assert name == "desk,planes.angle_deg=3,planes.min_points=100,manhattan=plane_svd,graph.tracks.manhattan=manhattan_prev"


def test_attribution_has_an_interval_over_recordings():
    cases = [case(0, [1.0, 2.0, 3.0, 5.0]), case(1, [1.0, 1.5, 4.0, 5.0])]
    found = {one["stage"]: one for one in attribution(cases) if one["figure"] == "ATE mm"}
    assert found["rotation"]["mean"] == pytest.approx((1.5 + 0.75) / 2) and found["manhattan"]["mean"] == pytest.approx((2.5 + 3.25) / 2)
    assert found[""]["mean"] == pytest.approx(4.0) and found[""]["half"] == pytest.approx(0.0)
    assert found["rotation"]["half"] == pytest.approx(12.7062 * 0.375, rel=1e-4)
    assert sections_of(cases)[1].title == "Attribution: Shapley value of each swap"


def test_every_pair_of_alternatives_has_a_verdict():
    rng = np.random.default_rng(0)
    cases = [case(k, [1.0, 1.0 + noise, 3.0 + noise, 3.0]) for k, noise in enumerate(rng.normal(0.0, 0.2, 6))]
    found = verdicts(cases)
    both = "manhattan=other rotation=other"
    assert [(one.first, one.second) for one in found if one.figure == "ms"] == [
        ("as recorded", "rotation=other"),
        ("as recorded", "manhattan=other"),
        ("as recorded", both),
        ("rotation=other", "manhattan=other"),
        ("rotation=other", both),
        ("manhattan=other", both),
    ]
    answers = {(one.first, one.second): one.answer for one in found if one.figure == "ATE mm"}
    assert answers["as recorded", "manhattan=other"] == "worse" and answers["rotation=other", "manhattan=other"] == "worse"
    assert answers["as recorded", "rotation=other"].startswith("no difference shown; ")
    assert {one.answer for one in found if one.figure == "ms"} == {"equal"}


def test_in_the_open_loop_each_swap_is_by_itself_and_compared_within_its_stage():
    single = single_swaps(parse_swaps(["planes=a", "manhattan=b,c"]))
    assert [one.label for one in single] == ["as recorded", "planes=a", "manhattan=b", "manhattan=c"]
    noise = np.random.default_rng(0).normal(0.0, 0.2, 6)
    cases = []
    for k, some in enumerate(noise):
        variants = [Variant(one, one.label, {"axes deg": axes}, 1.0, 1.1) for one, axes in zip(single, [1.0, 1.0, 3.0 + some, 1.0 - some])]
        cases.append(Case(f"{k}/run.mcap", 10, ["planes", "manhattan"], [], np.nan, 4.4, variants, feedback="recorded"))
    found = {(one.first, one.second): one for one in verdicts(cases)}
    assert list(found) == [(single[0].label, "planes=a"), *combinations(["as recorded", "manhattan=b", "manhattan=c"], 2)]
    assert found["as recorded", "planes=a"].answer == "equal" and found["as recorded", "manhattan=b"].answer == "worse"
    with pytest.raises(UsageError, match="these values make 65 alternatives, more than 64; give fewer values at once"):
        single_swaps(parse_swaps([f"planes.angle_deg={','.join(map(str, range(64)))}"]))
    least = min(found.values(), key=lambda one: one.p)
    assert least.corrected == pytest.approx(3 * least.p)  # the pair that is equal by construction does not count


def test_verdicts_are_first_in_text_and_markdown():
    cases = [case(number, [3.0, 1.0, 5.0, 3.0]) for number in (0, 1)]
    found, sections = verdicts(cases), sections_of(cases)
    lines = lines_of(found)
    assert lines[0] == "as recorded against rotation=other: ATE 3.00 -> 1.00 mm, -2.00 (95 %: -2.00 to -2.00): better"
    assert as_text(lines, sections).startswith(f"Verdicts\n{lines[0]}\n{lines[1]}\n")
    assert as_markdown(lines, sections).startswith(f"## Verdicts\n\n- {lines[0]}\n- {lines[1]}\n")
    written = json.loads(json.dumps(as_json(cases, found, sections)))["verdicts"]
    assert [one["text"] for one in written] == lines and written[0]["difference"] == -2.0 and written[0]["answer"] == "better"


def test_cost_is_against_a_full_run_with_the_same_swap():
    """The recorded run took 9 s; the swap adds 50 ms to each of 10 frames, so a full run with it takes 9.5 s."""
    one = replace(case(0, [1.0, 2.0], stages=("manhattan",)), full_s=9.0)
    one.variants[1].figures["ms"] = 51.0
    assert cost_table([one]).rows[1:] == [
        ["as recorded", "1.00", "1.10", "0.00", "1.10", "9.00", "8.2"],
        ["manhattan=other", "1.00", "1.10", "0.00", "1.10", "9.50", "8.6"],
    ]


def test_errors_of_frames_are_kept_beside(tmp_path):
    errors = [{"ATE mm": np.array([1.0, np.nan])}, {}, {"axes deg": np.array([0.5])}]
    write_errors(tmp_path / "errors.npz", errors)
    found = read_errors(tmp_path / "errors.npz", 3)
    assert [list(one) for one in found] == [["ATE mm"], [], ["axes deg"]]
    np.testing.assert_array_equal(found[0]["ATE mm"], errors[0]["ATE mm"])
    (tmp_path / "errors.npz").write_bytes(b"PK\x03\x04 cut off")
    assert read_errors(tmp_path / "errors.npz", 3) is None and read_errors(tmp_path / "nowhere.npz", 3) is None
    with pytest.raises(DataError, match="cannot be written"):
        write_errors(tmp_path / "nowhere" / "errors.npz", errors)


@pytest.fixture
def ablation(tmp_path):
    """The ablation of two recordings as `ablate` writes it, with errors of frames."""
    cases = {}
    for number, shift in enumerate((0.0, 0.5)):
        found = replace(case(number, [3.0, 1.0, 5.0 + shift, 3.0]), swaps=["manhattan=other", "rotation=other"])
        found.variants[1].parting = Parting(0, "rotation", "R", "0.1", 7, 4 + number, 2.0 + number, "mm")
        cases[str(number)] = case_to_dict(found)
        errors = [{"ATE mm": np.full(10, variant.figures["ATE mm"])} for variant in found.variants]
        errors[1]["ATE mm"][:3] = np.nan
        write_errors(tmp_path / f"errors-{number}.npz", errors)
    (tmp_path / "ablation.json").write_text(json.dumps(cases))
    (found,) = ablations_of([tmp_path, tmp_path / "nowhere"])
    return found


def test_a_case_is_read_as_it_was_written(tmp_path):
    found = case(0, [3.0, 1.0, 5.0, 3.0])
    assert case_from_dict(json.loads(json.dumps(case_to_dict(found)))).variants == found.variants
    (tmp_path / "ablation.json").write_text('{"a": {"variants": 3}}')
    with pytest.raises(DataError, match="is not an ablation"):
        ablations_of([tmp_path])


def test_the_page_of_an_ablation_has_a_chart_with_intervals_of_each_figure(ablation):
    assert ablation.title.endswith(": 2 recordings, closed loop")
    against = [one for one in verdicts(ablation.cases) if one.first == "as recorded"]
    charts = charts_of(ablation.cases, against)
    assert [chart["name"] for chart in charts] == ["ATE mm", "ms"]
    ate, ms = charts
    assert [(row["label"], row["text"]) for row in ate["rows"]] == [
        ("as recorded", "3.00"),
        ("rotation=other", "1.00, -2.00 (95 %: -2.00 to -2.00)"),
        ("manhattan=other", "5.25, +2.25 (95 %: -0.93 to +5.43)"),  # 12.7062 standard errors of 0.25
        ("manhattan=other rotation=other", "3.00, 0.00 (95 %: 0.00 to 0.00)"),
    ]
    assert ate["scale"] == ("1.00", "8.43") and ate["reference"] == ate["rows"][0]["dot"] == pytest.approx(4 + 92 * 2 / 7.4266, abs=0.01)
    assert ate["rows"][2]["dot"] == pytest.approx(4 + 92 * 4.25 / 7.4266, abs=0.01)
    assert ate["rows"][2]["interval"] == (pytest.approx(4 + 92 * 1.0734 / 7.4266, abs=0.01), 96.0)
    assert ms["scale"] == ("", "") and [row["dot"] for row in ms["rows"]] == [50.0] * 4  # equal


def test_the_page_of_an_ablation_has_verdicts_attribution_curves_and_its_command(ablation):
    page = ablation_page(ablation, pictures=True)
    html5lib.HTMLParser(strict=True).parse(page)
    assert "<code>trihedron ablate 0/run.mcap 1/run.mcap manhattan=other rotation=other out=again</code>" in page
    assert "<li>as recorded against rotation=other: ATE 3.00 -&gt; 1.00 mm, -2.00 (95 %: -2.00 to -2.00): better</li>" in page
    assert page.index("as recorded against") < page.index("<details>") < page.index("rotation=other against manhattan=other: ATE")
    assert "<title>manhattan=other: 5.25, +2.25 (95 %: -0.93 to +5.43)</title>" in page
    assert "ATE over time, mm; the largest is 5.5." in page and page.count("<polyline") == 4
    assert "rotation=other: frame 5 of 1/run.mcap, 3 mm apart; 7 of 10 frames differ" in page
    assert "manhattan=other: equal to the recorded configuration in all frames" in page
    assert "Attribution: Shapley value of each swap" in page and "<td>+2.12 ± 1.59</td>" in page


def test_the_index_of_the_pages_leads_to_the_ablation(ablation, tmp_path):
    write_site([], tmp_path / "site", "Results", pictures=False, ablations=[ablation])
    assert f'<li><a href="ablations/{ablation.name}.html">{ablation.title}</a></li>' in (tmp_path / "site" / "index.html").read_text()
    assert (tmp_path / "site" / "ablations" / f"{ablation.name}.html").read_text() == ablation_page(ablation, pictures=False)


def test_the_command_of_an_open_loop_says_so(ablation):
    (first, _) = ablation.cases
    opened = replace(ablation, cases=(replace(first, feedback="recorded", budget={"": {"ATE mm": 1.0}}),))
    assert opened.command == "trihedron ablate 0/run.mcap manhattan=other rotation=other feedback=recorded --budget out=again"
    assert replace(ablation, cases=(replace(first, swaps=[]),)).command == ""  # of an older version


def test_bars_of_the_attribution():
    figures = attribution_bars([case(number, [3.0, 1.0, 5.0, 3.0]) for number in (0, 1)])
    assert [figure["name"] for figure in figures] == ["ATE mm", "ms"]
    bars = {bar["label"]: (bar["left"], bar["length"], bar["text"]) for bar in figures[0]["bars"]}
    assert bars["manhattan=other"] == (50.0, 50.0, "+2.00 ± 0.00") and bars["rotation=other"] == (0.0, 50.0, "-2.00 ± 0.00")


def translation(index, x):
    return Translation(index, 1000 * index, np.array([x, 0.0, 0.0]), np.eye(3), np.empty((0, 3)), np.zeros(3, np.int32), True)


def test_a_star_stands_for_all_plugins_that_can_be_chosen_alone():
    (swap,) = parse_swaps(["pose=*"])
    names = {word.partition("=")[2] for (word,) in swap.levels[1:]}
    assert {"refine", "direct", "open3d_icp"} <= names and not {"icp", "none"} & names  # icp needs a model
    (swap,) = parse_swaps(["lines=*"])
    assert ("lines=onnx",) not in swap.levels  # which needs a file


def test_shapley_values_of_one_recording_have_intervals_from_its_frames():
    """Two swaps that each add half of the squared error of the other: 100 recordings of 400 frames of the same truth."""
    rng, within = np.random.default_rng(0), []
    scales = [1.0, 1.2, 1.1, 1.5]  # as recorded, rotation, manhattan, both
    for number in range(100):
        found = case(number, scales)
        common = rng.normal(size=400)
        for variant, scale in zip(found.variants, scales):
            variant.errors["ATE mm"] = scale * np.abs(0.7 * common + np.sqrt(0.51) * rng.normal(size=400))
        shares = {one["stage"]: one for one in attribution([found]) if one["figure"] == "ATE mm"}
        for variant in found.variants:
            variant.figures["ATE mm"] = float(np.sqrt(np.mean(variant.errors["ATE mm"] ** 2)))
        means = {one["stage"]: one["mean"] for one in attribution([found]) if one["figure"] == "ATE mm"}
        assert means["manhattan"] + means["rotation"] == pytest.approx(means[""])
        within.append([abs(means[stage] - true) < shares[stage]["half"] for stage, true in (("manhattan", 0.2), ("rotation", 0.3), ("", 0.5))])
    assert (np.mean(within, axis=0) > 0.88).all() and np.mean(within) < 0.99


@pytest.mark.slow
def test_every_plugin_is_computed_alone_on_the_recorded_past_of_another(tmp_path, capsys):
    room = ["dataset.width=320", "dataset.height=240", "dataset.length=8", "model=tsdf"]
    assert main(["run", *room, f"out={tmp_path}/run"]) == 0
    recorded = {topic for topic in Recording(tmp_path / "run" / "run.mcap").topics if topic in SLOTS}
    slots = [slot for slot in SLOTS if slot in recorded and len(parse_swaps([f"{slot}=*"])[0].levels) > 2]
    assert {"planes", "manhattan", "tracks", "rotation", "translation", "matches", "pose"} <= set(slots)
    for slot in slots:
        assert main(["ablate", f"{tmp_path}/run", f"{slot}=*", "feedback=recorded", f"out={tmp_path}/{slot}"]) == 0, capsys.readouterr().err


def test_where_two_variants_part():
    parting = Parting()
    for index, apart in enumerate((0.0, 0.0, 0.002, 0.005, 0.001)):
        parting.compare(index, ["translation"], {"translation": translation(index, 1.0)}, {"translation": translation(index, 1.0 + apart)})
    assert (parting.frame, parting.topic, parting.field, parting.frames) == (2, "translation", "t_world_camera", 3)
    assert (parting.worst, parting.unit) == (3, "mm") and parting.distance == pytest.approx(5.0)


def test_an_unsupported_frame_is_no_value():
    seen, sigma = translation(0, 1.0), 1e-4 * np.eye(3)
    found, kept = (ManhattanFrame.single(seen, np.eye(3), sigma, np.full(3, 9, np.int32), np.full(3, 0.01), supported) for supported in (True, False))
    assert distance(found, found) == (0.0, "deg") and distance(found, kept) is None
    errors = StageErrors({1000: np.eye(4)})
    for value in (found, kept, None):
        errors.take("manhattan", {"manhattan": value and replace(value, stamp_ns=1000)})
    assert errors.figures(errors.of_frames())["values %"] == pytest.approx(100 / 3) and len(errors.axes) == 1


def test_without_ground_truth_a_line_says_what_single_stages_are_measured_by():
    found = case(0, [1.0, 2.0, 3.0, 4.0])
    for variant in found.variants:
        variant.figures["planes mm"] = 3.0
    line = "there is no ground truth: single stages are measured by the poses of the recorded run, which is agreement with it and no error"
    assert line not in alternatives_table([found]).note
    assert alternatives_table([replace(found, true=False)]).note.splitlines()[-1] == line


def test_remarks_on_the_truth_stand_below_the_attribution():
    found = replace(case(0, [1.0, 2.0, 3.0, 4.0]), budget={"": {"ATE mm": 1.0}, "map": {"ATE mm": 0.9}}, remarks=["10 poses are too few."])
    section = attribution_table([case_from_dict(case_to_dict(found))])
    assert section.rows[-1][:2] == ["truth in the place of map", "-0.10"]
    assert section.note == f"{OF_FRAMES}\nTruth: 10 poses are too few."


def test_errors_of_a_stage_alone():
    errors = StageErrors({1000 * index: np.eye(4) for index in range(4)})
    for index in range(4):
        errors.take("translation", {"translation": translation(index, 0.003) if index else None})
    of_frames = errors.of_frames()
    figures = errors.figures(of_frames)
    assert figures["translation mm"] == pytest.approx(3.0) and figures["values %"] == 75.0
    assert np.isnan(of_frames["translation mm"][0]) and of_frames["translation mm"][1:] == pytest.approx([3.0] * 3)
    assert np.isnan(figures["axes deg"]) and distance(translation(0, 0.0), None) is None


def test_a_run_folder_of_an_ablation_is_a_recording(tmp_path):
    folder = tmp_path / "manhattan=plane_svd"
    folder.mkdir()
    (folder / "run.mcap").touch()
    options = options_of([str(folder), "manhattan=mixture", f"out={tmp_path / 'o'}"])
    assert options.recordings == (folder / "run.mcap",) and options.swaps == ("manhattan=mixture",)


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        ("manhattan=plane_svd out=o", 2, "ablate: no recording is given; give RUN.mcap first"),
        ("run.mcap out=o", 2, "ablate: nothing is swapped; give STAGE=PLUGIN,PLUGIN or STAGE.OPTION=VALUE,VALUE"),
        ("own.mcap manhattan=plane_svd", 2, "out: is not given; give out=DIR for the alternatives"),
        ("own.mcap manhattan=plane_svd out=o feedback=recorder", 2, "feedback: is 'recorder'; did you mean 'recorded'?"),
        ("own.mcap manhattan=plane_svd out=o threads=0", 1, "threads: 0 is not a number of threads; give 1 to 256"),
        ("a.mcap b.mcap bundle=none out=o --budget", 2, "--budget: is of one run, and 2 recordings are given; give one of them"),
        ("own.mcap manhatan=plane_svd out=o", 2, "manhatan: is not a stage, nor an option or a wire of one; did you mean 'manhattan'?"),
        ("own.mcap dataset.length=3 out=o", 2,
         "dataset.length: an ablation has the frames of its recordings; make a recording of the other frames, and give it too"),
        ("own.mcap planes.angle_deg=interval(1,2) out=o", 2,
         "planes.angle_deg: 'planes.angle_deg=interval(1,2)' is a space to search in; give values A,B"),
        ("nowhere.mcap bundle=none out=o", 1, "nowhere.mcap: there is no such recording; give RUN.mcap or a run folder"),
        ("own.mcap nowhere.mcap bundle=none", 1, "nowhere.mcap: there is no such recording; give RUN.mcap or a run folder"),
    ],
)  # fmt: skip
def test_mistakes_are_one_line(tmp_path, capsys, monkeypatch, words, code, message):
    monkeypatch.chdir(tmp_path)
    os.symlink(Path(__file__).parents[1] / "fuzz" / "seeds" / "own.mcap", "own.mcap")
    assert main(["ablate", *words.split()]) == code
    assert capsys.readouterr().err.splitlines()[-1] == f"trihedron: {message}"


def test_a_folder_holds_the_ablations_of_one_recording(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    record = ["run", "dataset.length=4", "dataset.width=160", "dataset.height=120", "threads=1"]
    for name in ("first", "second"):
        assert main([*record, f"out={name}"]) == 0
    assert main(["ablate", "first", "manhattan=plane_svd", "out=found"]) == 0
    before, _ = Path("found/ablation.json").read_bytes(), capsys.readouterr()
    for words in (["manhattan=plane_svd"], ["bundle=none", "--dry-run"]):
        assert main(["ablate", "second", *words, "out=found"]) == 1
        lines = capsys.readouterr().err.splitlines()
        assert lines[-1] == "trihedron: found: holds the ablation of first/run.mcap; give another out=DIR"
    assert Path("found/ablation.json").read_bytes() == before
    assert main(["ablate", "first", "bundle=none", "out=found"]) == 0
    assert "found: keeps what it holds of first/run.mcap besides: manhattan=plane_svd\n" in capsys.readouterr().err
    assert {tuple(one["swaps"]) for one in json.loads(Path("found/ablation.json").read_text()).values()} == {
        ("manhattan=plane_svd",),
        ("bundle=none",),
    }
    assert main(["ablate", "second", "manhattan=plane_svd", "out=first"]) == 1
    assert capsys.readouterr().err.splitlines()[-1] == "trihedron: first: is the folder of a run; give another out=DIR"
    assert main(["ablate", "first", "second", "bundle=none", "out=both"]) == 0
    assert main([*record, "out=third"]) == 0
    assert main(["ablate", "third", "bundle=none", "out=both"]) == 0
    kept = [line for line in capsys.readouterr().err.splitlines() if "keeps" in line]
    assert kept == [f"both: keeps what it holds of {name}/run.mcap besides: bundle=none" for name in ("first", "second")]
    assert main([*record, "dataset.seed=1", "out=first"]) == 0  # anew: what is known of it is of another recording now
    assert main(["ablate", "first", "bundle=none", "out=found"]) == 0
    assert "keeps" not in capsys.readouterr().err
    assert [one["swaps"] for one in json.loads(Path("found/ablation.json").read_text()).values()] == [["bundle=none"]]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_wrong_sign_in_translation_is_attributed_to_translation(tmp_path, capsys, faulty):
    assert main(["run", "graph=structural_no_refine", "dataset.length=14", *SMALL, f"out={tmp_path}/run"]) == 0
    words = ["manhattan=mean_shift,plane_svd", "rotation=drift_free", "translation=levenberg_marquardt,wrong_sign"]
    command = ["ablate", f"{tmp_path}/run/run.mcap", *words, f"out={tmp_path}/ablation", "threads=1", f"--json={tmp_path}/found.json"]
    capsys.readouterr()
    assert main(command) == 0
    found = json.loads((tmp_path / "found.json").read_text())
    shares = {one["stage"]: one["mean"] for one in found["attribution"] if one["figure"] == "RPE 1 frame mm"}  # ATE aligns a mirrored straight line
    assert set(shares) == {"manhattan", "translation", ""} and shares["translation"] > 0.95 * shares[""] > 10.0
    assert abs(shares["manhattan"]) < 0.05 * shares["translation"]
    mutated = next(one for one in found["recordings"][0]["variants"] if one["change"] == "translation=wrong_sign")
    assert (mutated["parting"]["topic"], mutated["parting"]["field"]) == ("translation", "t_world_camera")
    picture = cv2.imread(mutated["picture"])
    assert picture.std() > 10.0 and (picture[:2] == 255).all()  # no title is cut off
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "ablation").rglob("*") if path.name != "ablation.json"}
    assert found["verdicts"][0]["text"].endswith(": too short to tell") and found["verdicts"][0]["figure"] == "ATE mm"
    first = capsys.readouterr().out
    assert main(command) == 0
    again = capsys.readouterr()
    assert "done already" in again.err and again.out == first
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "ablation").rglob("*") if path.name != "ablation.json"}


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_closed_loop_gives_the_bytes_of_a_full_run_and_open_loop_those_of_a_replay(tmp_path, capsys):
    room = ["dataset.length=14", *SMALL]
    swaps = ["manhattan=plane_svd", "bundle=none"]
    assert main(["run", *room, "record.frames=true", "record.topics=[normals]", f"out={tmp_path}/run"]) == 0
    assert main(["run", *room, *swaps, f"out={tmp_path}/full"]) == 0
    source = f"{tmp_path}/run/run.mcap"
    assert main(["ablate", source, *swaps, f"out={tmp_path}/closed", f"--json={tmp_path}/closed.json", "--budget"]) == 0
    own, whole = Recording(tmp_path / "closed" / "manhattan=plane_svd,bundle=none" / "run.mcap"), Recording(tmp_path / "full" / "run.mcap")
    assert {"manhattan", "rotation", "translation", "pose", "map"} <= own.topics and "keypoints" not in own.topics
    for topic in own.topics - {"frames"}:
        assert list(own.messages(f"/{topic}")) == list(whole.messages(f"/{topic}")), topic
    one, other = (json.loads((folder / "metrics.json").read_text()) for folder in (own.path.parent, whole.path.parent))
    assert one == other
    found = json.loads((tmp_path / "closed.json").read_text())["recordings"][0]
    assert found["changed"] == "" and found["shared"] == []
    assert set(found["budget"]) >= {"", "rotation", "translation", "map"}
    assert main(["compare", f"{tmp_path}/closed"]) == 0 and "manhattan=plane_svd bundle=none" in capsys.readouterr().out

    open_loop = ["feedback=recorded", "manhattan=plane_svd"]
    assert main(["ablate", source, *open_loop, f"out={tmp_path}/open", f"--json={tmp_path}/open.json"]) == 0
    assert main(["run", f"replay={source}", "only=[manhattan]", *open_loop, f"out={tmp_path}/replay"]) == 0
    own, replay = Recording(tmp_path / "open" / "manhattan=plane_svd" / "run.mcap"), Recording(tmp_path / "replay" / "run.mcap")
    assert own.topics == {"manhattan", "frames"} and list(own.messages("/manhattan")) == list(replay.messages("/manhattan"))
    alternatives = json.loads((tmp_path / "open.json").read_text())["recordings"][0]["variants"]
    assert all(0.0 < variant["figures"]["axes deg"] < 1.0 and "ATE mm" in variant["figures"] for variant in alternatives)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_several_recordings_from_python(tmp_path):
    import trihedron as th

    runs = [th.run("dataset.length=8", *SMALL, f"dataset.seed={seed}", out=tmp_path / f"seed{seed}", quiet=True) for seed in (0, 1, 2)]
    found = th.ablate(runs, "bundle=none", out=tmp_path / "ablation")
    assert sorted(path.name for path in found.folders["bundle=none"]) == [f"seed{seed},bundle=none" for seed in (0, 1, 2)]
    assert {(one["first"], one["second"]) for one in found.figures["verdicts"]} == {("as recorded", "bundle=none")}
    assert found.verdicts[0].startswith("as recorded against bundle=none: ATE ") and str(found).startswith(f"Verdicts\n{found.verdicts[0]}\n")


def test_a_dry_run_says_what_is_computed_read_and_shared_and_writes_nothing(tmp_path, capsys):
    source, before = Path(__file__).parents[1] / "fuzz" / "seeds" / "own.mcap", tmp_path / "rotation=procrustes" / "run.mcap"
    before.parent.mkdir()
    before.touch()  # of an ablation with other values
    words = [str(source), "rotation=procrustes", "translation=irls", "feedback=recorded", f"out={tmp_path}"]
    assert main(["ablate", *words, "--dry-run"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert list(tmp_path.iterdir()) == [before.parent] and before.stat().st_size == 0
    assert said[0] == f"{source}: 3 alternatives, 5 frames" and said[-1] == "24 stages, 10 of them different, which are computed"
    assert said[1:8] == [
        "1  as recorded: to run",
        "   computes again: rotation, translation",
        "   computes once, not recorded: normals, lines, segments, planes, manhattan, tracks",
        "   reads: dataset, frames, keypoints, rotation, pose, map",
        "   read for 2, 3 too: dataset, frames, keypoints, rotation, pose, map",
        "   computed for 2, 3 too: normals, lines, segments, planes, manhattan, tracks",
        "   computed for 3 too: rotation",
    ]
    assert [line for line in said if line[0].isdigit()][1:3] == ["2  rotation=procrustes: to run again", "3  translation=irls: to run"]
    assert said[-2] == "   computed for 1 too: rotation"


def test_a_recording_ablates_itself_from_python(tmp_path):
    import trihedron as th

    source = Path(__file__).parents[1] / "fuzz" / "seeds" / "own.mcap"
    found = th.Recording(source).ablate("lines=opencv_lsd", out=tmp_path, feedback="recorded", keypoints__features=200)
    assert list(found.folders) == ["as recorded", "lines=opencv_lsd", "keypoints.features=200"]
    assert all((folder / "run.mcap").is_file() for (folder,) in found.folders.values())
    assert str(found) == str(th.ablate(source, "lines=opencv_lsd", "keypoints.features=200", out=tmp_path, feedback="recorded"))


def test_values_of_other_code_are_named(tmp_path):
    words = ["run", "dataset.width=160", "dataset.height=120", "dataset.length=4", "outputs=[rotation]"]
    for name, more in (("a", []), ("b", []), ("c", ["dataset.seed=1"])):
        assert main([*words, *more, f"out={tmp_path / name}"]) == 0
    a, b, c = (Recording(tmp_path / name / "run.mcap") for name in "abc")
    assert changed_by_code(a, b) == ""
    assert re.fullmatch(r"manhattan\.rotations from frame \d on", changed_by_code(a, c))
