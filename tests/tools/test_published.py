"""The published figures that tables and pages stand beside."""

import re

import pytest

from trihedron.tools import download
from trihedron.tools.published import paper, peer_figures, peers, sequence_of, sequences


def test_every_row_has_a_figure_for_each_system():
    for table in ("ate_m", "surface_m", "drift_m"):
        rows = dict(paper()[table])
        systems = rows.pop("systems")
        assert all(len(values) == len(systems) for values in rows.values()) and set(rows) <= set(sequences())
    assert all(len(paper()["time_ms"][name]) == len(paper()["time_ms"]["stages"]) for name in ("median", "mean", "std"))
    assert set(paper()["systems"].values()) <= set(paper()["ate_m"]["systems"])
    assert {cell for cells in peers()["programs"].values() for cell in cells} == set(peers()["sequences"])


def test_every_sequence_can_be_downloaded_and_is_known_by_its_folder():
    known = download.sequences()
    for name, entry in sequences().items():
        sequence = known[entry["download"]]
        assert sequence_of(sequence.name) == sequence_of(f"rgbd_dataset_{sequence.published}") == name
    assert sequence_of("icl_nuim_of_kt3") == "of-kt3" and sequence_of("tum_fr3_structure_notexture_far") == "snot-far"
    assert sequence_of("freiburg3_nostructure_notexture_far") is None and sequence_of("") is None


@pytest.mark.parametrize("name", ["icl_office_rendered", "hololens_walk"])
def test_folders_of_other_sequences_have_no_published_figure(name):
    assert sequence_of(name) is None and any(re.search(entry["folder"], name) for entry in peers()["sequences"].values())


def test_other_programs_are_compared_where_a_twentieth_of_their_frames_is_skipped_at_most():
    of_all = peer_figures("seven_scenes_kitchen", 160)
    assert of_all["ORB-SLAM2"]["ate_m"] and peer_figures("seven_scenes_kitchen", 152) == of_all
    assert peer_figures("seven_scenes_kitchen", 151) == peer_figures("seven_scenes_kitchen", 161) == {}
