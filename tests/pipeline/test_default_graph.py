"""The promises of the dataflow over the whole default graph: bytes do not depend on threads, and every stage runs again alone, bit for bit."""

import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from trihedron.pipeline.record.embedded_images import topic_of

sys.path.insert(0, str(Path(__file__).parent))
from toys import contents, run_in

FRAMES = 104
STAGES = [
    "dataset", "normals", "keypoints", "lines", "segments", "planes", "manhattan", "tracks", "rotation", "translation", "matches", "pose", "map",
    "bundle",
]  # fmt: skip
CHANGES = {
    "dataset": "dataset.seed=5",
    "normals": "normals.patch_px=14",
    "keypoints": "keypoints.features=500",
    "lines": "lines.min_length_px=40",
    "segments": "segments.share=0.8",
    "planes": "planes.min_pixels=4000",
    "manhattan": "manhattan.bandwidth_deg=3",
    "tracks": "tracks.radius_px=12",
    "rotation": "rotation.max_weight=3",
    "translation": "translation.line_sigma_px=3",
    "matches": "matches.radius_px=3",
    "pose": "pose.line_sigma_px=3",
    "map": "map.memory=20",
    "bundle": "bundle.keyframes=2",
}
RECORD = ["dataset=synthetic", f"dataset.frames=0:{FRAMES}", "dataset.width=320", "dataset.height=240"]
RECORD += ["record.frames=true", "record.topics=[normals]"]
RECORD += ["loop.every=1", "loop.away_m=0.2", "loop.shared=1000", "loop.max_through=1", "loop.drift_share=0.05", "loop.candidates=20"]
RECORD += ["loop.min_score=10", "loop.min_share=0.1"]  # closes some that are none


def without(source, topic, path):
    """A copy of a recording, message by message, that lacks one topic."""
    with open(source, "rb") as file, open(path, "wb") as copy:
        reader, writer, channels = make_reader(file), Writer(copy, compression=CompressionType.NONE), {}
        writer.start()
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        for record in reader.iter_attachments():
            writer.add_attachment(0, 0, record.name, record.media_type, record.data)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if topic_of(channel.topic) == topic:
                continue
            if channel.id not in channels:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, schema_id)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    run_in(folder, [*RECORD, f"out={folder}/two", "threads=2"])
    return folder


@pytest.mark.slow
def test_every_topic_has_the_same_bytes_for_one_thread_and_two(recorded):
    run_in(recorded, [*RECORD, f"out={recorded}/one", "threads=1"])
    one, two = contents(recorded / "one" / "run.mcap"), contents(recorded / "two" / "run.mcap")
    assert set(one) == set(two) and set(map(topic_of, one)) >= {*STAGES, "loop"}
    assert min(log_time for log_time, _ in one["/loop"]) < (FRAMES - 10) / 30 * 1e9  # and the map has applied it
    assert [topic for topic in one if one[topic] != two[topic]] == []
    for name in ("trajectory.txt", "trajectory_causal.txt", "metrics.json"):
        assert (recorded / "one" / name).read_bytes() == (recorded / "two" / name).read_bytes()


@pytest.mark.slow
def test_every_stage_run_again_alone_gives_its_bytes_and_a_change_changes_them(recorded):
    source = contents(recorded / "two" / "run.mcap")
    jobs = []
    for stage in STAGES:
        without(recorded / "two" / "run.mcap", stage, recorded / f"without_{stage}.mcap")
        again = [f"replay={recorded}/without_{stage}.mcap", f"only=[{stage}]"]
        jobs += [[*again, f"out={recorded}/same_{stage}"], [*again, f"out={recorded}/changed_{stage}", CHANGES[stage]]]
    run_in(recorded, *jobs)
    for stage in STAGES:
        same, changed = contents(recorded / f"same_{stage}" / "run.mcap"), contents(recorded / f"changed_{stage}" / "run.mcap")
        topics = [topic for topic in source if topic_of(topic) == stage]
        assert topics and min(len(source[topic]) for topic in topics) >= (100 if stage not in ("map", "bundle") else 3)
        assert {topic for topic in same if topic_of(topic) in STAGES} == set(topics)  # nothing is copied that was not computed
        for topic in topics:
            assert same[topic] == source[topic] != changed[topic], topic


@pytest.mark.slow
def test_recorded_feedback_gives_the_same_bytes_too(recorded):
    whole = recorded / "two" / "run.mcap"
    stateful = ["manhattan", "tracks", "rotation", "pose", "map"]
    run_in(recorded, *([f"replay={whole}", f"only=[{s}]", "feedback=recorded", f"out={recorded}/feedback_{s}"] for s in stateful))
    source = contents(whole)
    for stage in stateful:
        assert contents(recorded / f"feedback_{stage}" / "run.mcap")[f"/{stage}"] == source[f"/{stage}"], stage


@pytest.mark.slow
def test_a_replay_with_new_poses_writes_their_trajectory(recorded):
    whole = recorded / "two" / "run.mcap"
    tracking = [f"replay={whole}", "only=[rotation,translation,matches,pose,map]", f"out={recorded}/tracking"]
    out = run_in(recorded, tracking, [f"replay={whole}", "only=[manhattan]", f"out={recorded}/axes"])
    assert "ATE" in out
    for name in ("trajectory.txt", "metrics.json"):
        assert (recorded / "tracking" / name).read_bytes() == (recorded / "two" / name).read_bytes()
    assert (recorded / "axes" / "run.mcap").exists() and not (recorded / "axes" / "trajectory.txt").exists()
