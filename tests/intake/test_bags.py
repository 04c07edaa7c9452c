"""A ROS 2 bag folder is one log, split or not; half a bag is refused."""

import hashlib
import shutil
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from pipeline.intake.ingest import ingest
from pipeline.intake.sources import files_of_bag
from pipeline.profiles.profile_files import load_profile
from pipeline.shell.profile.check import check_samples
from pipeline.store.samples import load_trials
from pipeline.store.storage import read_trials

STORE = get_typestore(Stores.ROS2_HUMBLE)
KINDS = {"db3": "rosbag", "mcap": "mcap"}
START = 1_700_000_000_000_000_000
TOML = """
name = "arm"
format = "FORMAT"
files = ["*.db3", "*.mcap"]
name_pattern = "K(?P<stiffness>[0-9.]+)"
step_at = "command edge"
columns.time = { name = "/joints.header.stamp", unit = "ns" }
columns.command = { name = "/joints.effort[0]", unit = "Nm", sign = 1 }
columns.position = { name = "/joints.position[0]", unit = "rad", sign = 1 }
[constants]
device = "arm"
experiment = "1"
motion = "rotation"
damping = 0.1
step = 1.5
sampling_period_s = 0.001
"""


def write_bag(folder: Path, kind: str, first: int, rows: int):
    names = ("sensor_msgs/msg/JointState", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    joints, header, stamp = (STORE.types[name] for name in names)
    plugin = StoragePlugin.SQLITE3 if kind == "db3" else StoragePlugin.MCAP
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        topic = writer.add_connection("/joints", joints.__msgtype__, typestore=STORE)
        for k in range(first, first + rows):
            ns = START + 1_000_000 * k
            head = header(stamp=stamp(sec=ns // 10**9, nanosec=ns % 10**9), frame_id="")
            message = joints(head, ["a"], np.array([k / 8]), np.array([0.0]), np.array([1.5 if k > 3 else 0.0]))
            writer.write(topic, ns, STORE.serialize_cdr(message, joints.__msgtype__))


def split_bag(folder: Path, kind: str, rows=(5, 3, 4)) -> Path:
    """A bag as `ros2 bag record` splits it: files NAME_0, NAME_1, ... and one metadata.yaml."""
    bag = folder / "K20"
    bag.mkdir(parents=True)
    first = 0
    for number, count in enumerate(rows):
        part = folder / "part"
        write_bag(part, kind, first, count)
        (part / f"part.{kind}").rename(bag / f"K20_{number}.{kind}")
        metadata = (part / "metadata.yaml").read_text()
        shutil.rmtree(part)
        first += count
    names = [f"K20_{number}.{kind}" for number in range(len(rows))]
    lines = metadata.splitlines()
    at = next(i for i, line in enumerate(lines) if "relative_file_paths" in line)
    indent = lines[at + 1][: lines[at + 1].index("-")]
    lines[at + 1 : at + 2] = [f"{indent}- {name}" for name in names]
    (bag / "metadata.yaml").write_text("\n".join(lines) + "\n")
    return bag


@pytest.fixture(params=list(KINDS))
def kind(request):
    return request.param


@pytest.fixture
def lab(tmp_path, kind):
    """Ingest the folder of logs by the profile; returns the report and what is stored."""
    (tmp_path / "arm.toml").write_text(TOML.replace("FORMAT", KINDS[kind]))

    def run(*paths):
        report = ingest([*paths] or [tmp_path / "logs"], tmp_path / "processed", tmp_path / "arm.toml", jobs=1)
        return report, read_trials(tmp_path / "processed") if report.ingested or report.skipped else None

    return run


def test_a_split_bag_is_one_log_of_all_its_files(tmp_path, kind, lab):
    bag = split_bag(tmp_path / "logs", kind)
    report, trials = lab()
    assert (report.found, report.ingested, report.quarantined) == (1, 1, ())
    assert [warning.code for warning in report.warnings] == ["coarse_sensor"]
    (row,) = trials.to_pylist()
    assert row["source_path"] == str(bag)
    files = sorted(bag.glob(f"*.{kind}"))
    hashes = "".join(hashlib.sha256(file.read_bytes()).hexdigest() for file in files)
    assert row["source_sha256"] == hashlib.sha256(hashes.encode()).hexdigest()
    assert row["source_size"] == sum(file.stat().st_size for file in files)
    assert row["stiffness"] == 20
    # rosbags reads the whole folder by itself
    with Reader(bag) as reader:
        read = [STORE.deserialize_cdr(data, topic.msgtype) for topic, _, data in reader.messages()]
    (trial,) = load_trials(tmp_path / "processed", trials)
    assert trial.rows == len(read) == 12
    assert trial.position.tolist() == [message.position[0] for message in read]
    assert trial.command.tolist() == [message.effort[0] for message in read]
    np.testing.assert_allclose(trial.time, np.arange(12) * 1e-3, rtol=5e-16)
    assert lab()[0].skipped == 1


def test_any_file_of_a_bag_stands_for_the_whole(tmp_path, kind, lab):
    bag = split_bag(tmp_path / "logs", kind)
    for file in (bag, *bag.iterdir()):
        report, trials = lab(file)
        assert (report.found, trials.num_rows) == (1, 1)
    (sample,) = check_samples(load_profile(tmp_path / "arm.toml"), [bag / f"K20_1.{kind}"])
    (trial,) = sample["trials"]
    assert trial["rows"] == 12


def test_a_changed_part_is_a_changed_log(tmp_path, kind, lab):
    bag = split_bag(tmp_path / "logs", kind)
    lab()
    shutil.rmtree(bag)
    split_bag(tmp_path / "logs", kind, rows=(5, 3, 6))
    report, trials = lab()
    assert (report.ingested, trials.column("rows").to_pylist()) == (1, [14])


def test_a_bag_of_one_file_is_named_by_its_folder_too(tmp_path, kind, lab):
    write_bag(tmp_path / "logs" / "K7", kind, 0, 6)
    report, trials = lab()
    assert (report.found, report.ingested) == (1, 1)
    assert trials.column("source_path").to_pylist() == [str(tmp_path / "logs" / "K7")]


def test_half_a_bag_is_refused(tmp_path, kind, lab):
    bag = split_bag(tmp_path / "logs", kind)
    (bag / f"K20_1.{kind}").rename(tmp_path / "kept")
    (refusal,) = lab()[0].quarantined
    assert refusal.path == str(bag)
    assert f"K20_1.{kind} is missing" in refusal.reason
    assert refusal.code == "partner-missing"
    (tmp_path / "kept").rename(bag / f"K20_1.{kind}")
    report, trials = lab()
    assert (report.ingested, report.quarantined, trials.num_rows) == (1, (), 1)


@pytest.mark.parametrize(
    "text",
    [
        "rosbag2_bagfile_information:\n  version: 4\n  relative_file_paths:\n    - a_0.db3\n    - a_1.db3\n  x: 1\n",
        "rosbag2_bagfile_information:\n  relative_file_paths: [a_0.db3, 'a_1.db3']\n",
        'rosbag2_bagfile_information:\n  relative_file_paths:\n  - "a/a_0.db3"\n  - /home/me/a/a_1.db3.zstd\n',
    ],
)
def test_ways_to_list_files(tmp_path, text):
    folder = tmp_path / "a"
    folder.mkdir()
    for name in ("a_0.db3", "a_1.db3", "other.db3", "notes.txt"):
        (folder / name).touch()
    (folder / "metadata.yaml").write_text(text)
    bag = files_of_bag(folder / "metadata.yaml")
    assert [file.name for file in bag] == ["a_0.db3", "a_1.db3"]
    assert files_of_bag(folder / "a_1.db3") == bag
    assert files_of_bag(folder / "other.db3") == files_of_bag(folder / "notes.txt") == ()


def test_other_metadata_and_lone_recordings_are_no_bags(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("run_0.mcap", "x_0.mcap", "x_1.mcap"):
        (folder / name).touch()
    assert files_of_bag(folder / "run_0.mcap") == ()
    for text in ("author: me\n", "rosbag2_bagfile_information:\n  version: 4\n"):
        (folder / "metadata.yaml").write_text(text)
        assert files_of_bag(folder / "metadata.yaml") == files_of_bag(folder / "run_0.mcap") == ()
