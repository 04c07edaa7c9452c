"""ROS 1 and 2 bags and MCAP files, written by rosbags."""

import sqlite3

import numpy as np
import pytest
from foreign_files import START, bag_file, joint_log, list_columns, read_frame, samples
from rosbags.typesys import get_types_from_msg

from pipeline.base.errors import LogError
from pipeline.readers.formats import refuse_other_kind

KINDS = [("bag", ""), ("bag", "lz4"), ("bag", "bz2"), ("db3", ""), ("db3", "zstd"), ("mcap", ""), ("mcap", "zstd")]
STAMPS = START + 1_000_000 * np.arange(40)


def form(kind):
    return "mcap" if kind == "mcap" else "rosbag"


def frame(kind, data, *wanted):
    return read_frame(form(kind), f"log.{kind}", data, wanted)


@pytest.fixture(scope="module")
def bags():
    return {(kind, packed): bag_file(kind, joint_log, packed) for kind, packed in KINDS}


@pytest.mark.parametrize(("kind", "packed"), KINDS)
def test_every_value_of_a_topic_comes_back(bags, kind, packed):
    _, position, _ = samples()
    wanted = ["/arm/joints.header.stamp", "/arm/joints.@received", "/arm/joints.name[1]", "/arm/joints.header.frame_id"]
    read = frame(kind, bags[kind, packed], *wanted, *(f"/arm/joints.position[{i}]" for i in range(3)))
    assert read.columns[wanted[0]].tolist() == STAMPS.tolist()
    assert read.columns[wanted[1]].tolist() == (STAMPS + 150).tolist()
    assert set(read.columns[wanted[2]]) == {"b"}
    assert set(read.columns[wanted[3]]) == {"base"}
    for i in range(3):
        assert read.columns[f"/arm/joints.position[{i}]"].tolist() == position[:, i].tolist()
    # every second message is followed by one of the other topic
    assert read.row.tolist() == [i + 1 + (i + 1) // 2 for i in range(40)]
    assert read.row_name == "message"
    assert read.attributes["/arm/joints@type"].endswith("/JointState")
    assert read.warnings == ()


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
def test_topics_are_joined_on_the_union_of_their_times(bags, kind):
    _, position, _ = samples()
    read = frame(kind, bags[kind, ""], "@received", "/arm/joints.position[0]", "/command.data")
    times = np.sort(np.concatenate([STAMPS + 150, STAMPS[::2] + 500]))
    assert read.columns["@received"].tolist() == times.tolist()
    joints = np.isin(times, STAMPS + 150)
    assert read.columns["/arm/joints.position[0]"][joints].tolist() == position[:, 0].tolist()
    assert np.isnan(read.columns["/arm/joints.position[0]"][~joints]).all()
    assert read.columns["/command.data"][~joints].tolist() == list(range(0, 40, 2))
    assert np.isnan(read.columns["/command.data"][joints]).all()
    assert read.row.tolist() == list(range(1, 61))


def test_time_of_the_rows_may_be_the_stamp(bags):
    read = frame("bag", bags["bag", ""], "@stamp", "/arm/joints.position[0]")
    assert read.columns["@stamp"].tolist() == STAMPS.tolist()


def two_robots(writer, store, is_ros1):
    """Two topics with headers, partly of equal stamps; one stamp comes twice and one goes back."""
    header = store.types["std_msgs/msg/Header"]
    wrench = store.types["geometry_msgs/msg/WrenchStamped"]
    time, vector = store.types["builtin_interfaces/msg/Time"], store.types["geometry_msgs/msg/Vector3"]
    inner = store.types["geometry_msgs/msg/Wrench"]
    for topic, stamps in (("/a", [1, 2, 2, 5]), ("/b", [2, 4, 3])):
        connection = writer.add_connection(topic, wrench.__msgtype__, typestore=store)
        for number, stamp in enumerate(stamps):
            head = header(stamp=time(sec=stamp, nanosec=7), frame_id="")
            force = vector(x=10.0 * stamp + number, y=0.0, z=0.0)
            message = wrench(header=head, wrench=inner(force=force, torque=force))
            writer.write(connection, 100 + number, store.serialize_cdr(message, wrench.__msgtype__))


def test_equal_stamps_are_joined_and_doubled_ones_kept():
    data = bag_file("mcap", two_robots)
    read = frame("mcap", data, "@stamp", "/a.wrench.force.x", "/b.wrench.force.x")
    assert read.columns["@stamp"].tolist() == [10**9 * s + 7 for s in (1, 2, 2, 3, 4, 5)]
    np.testing.assert_array_equal(read.columns["/a.wrench.force.x"], [10, 21, 22, np.nan, np.nan, 53])
    np.testing.assert_array_equal(read.columns["/b.wrench.force.x"], [np.nan, 20, np.nan, 32, 41, np.nan])
    alone = frame("mcap", data, "/b.header.stamp", "/b.wrench.force.x")
    assert alone.columns["/b.header.stamp"].tolist() == [10**9 * s + 7 for s in (2, 4, 3)]
    assert alone.warnings == ()


@pytest.mark.parametrize(
    ("wanted", "words"),
    [
        (
            ["/arm/joint.position[0]"],
            r"no column '/arm/joint.position\[0\]'. Nearest: /arm/joints.position\[0\]",
        ),
        (["/arm/joints.positions[0]"], r"Nearest: /arm/joints\.position\[0\]"),
        (["/arm/joints.position[3]"], r"no column '/arm/joints\.position\[3\]'"),
        (["/arm/joints.position"], r"Name one element .*: /arm/joints.position\["),
        (["/arm/joints.effort[0]"], "no column"),
        (["@stamp", "/arm/joints.position[0]", "/command.data"], "'/command' have no header.*'@received'"),
        (["@stamp", "@received", "/command.data"], "'/command' have no header"),
        (["@received"], "no column '@received'"),
    ],
)
def test_wrong_names_are_explained(bags, wanted, words):
    for kind in ("bag", "db3", "mcap"):
        with pytest.raises(LogError, match=f"log.{kind}.*{words}"):
            frame(kind, bags[kind, ""], *wanted)


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
def test_topics_are_listed(bags, kind):
    infos = {info.name: info for info in list_columns(form(kind), f"log.{kind}", bags[kind, ""])}
    assert infos["/arm/joints.header.stamp"].first == tuple(map(str, STAMPS[:3]))
    assert (infos["/arm/joints.header.stamp"].rows, infos["/arm/joints.header.stamp"].hint) == (40, "ns")
    assert infos["/arm/joints.position[2]"].dtype == "number"
    assert infos["/command.data"].hint.endswith("Float64")
    assert infos["/command.@received"].rows == 20


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_a_recording_that_was_cut_is_refused_with_what_mends_it(bags, kind):
    whole = bags[kind, ""]
    with pytest.raises(LogError, match=r"`rosbag reindex`.*`mcap recover`"):
        frame(kind, whole[: int(0.9 * len(whole))], "/arm/joints.position[0]")


def without_definitions(data):
    """The same database as ROS 2 wrote it before it kept definitions."""
    database = sqlite3.connect(":memory:")
    database.deserialize(data)
    for table in ("message_definitions", "schema", "metadata"):
        database.execute(f"DROP TABLE {table}")
    database.commit()
    image = bytes(database.serialize())
    database.close()
    return image


def test_own_message_types_come_with_their_definition():
    text = (
        "float64[3] q\nbuiltin_interfaces/Duration lag\nint8 LOW=1\nSub[] parts\n"
        + "=" * 80
        + "\nMSG: lab_msgs/Sub\nuint64 n\n"
    )

    def fill(writer, store, is_ros1):
        store.register(get_types_from_msg(text, "lab_msgs/msg/State"))
        state, sub = store.types["lab_msgs/msg/State"], store.types["lab_msgs/msg/Sub"]
        connection = writer.add_connection("/state", "lab_msgs/msg/State", typestore=store)
        lag = store.types["builtin_interfaces/msg/Duration"](sec=-1, nanosec=5)
        for n in range(3):
            message = state(q=np.arange(3.0) + n, lag=lag, parts=[sub(n=2**64 - 1 - n)])
            writer.write(connection, n, store.serialize_cdr(message, "lab_msgs/msg/State"))

    for kind in ("mcap", "db3"):
        data = bag_file(kind, fill)
        read = frame(kind, data, "/state.q[2]", "/state.lag", "/state.parts[0].n")
        assert read.columns["/state.q[2]"].tolist() == [2.0, 3.0, 4.0]
        assert read.columns["/state.lag"].tolist() == [-999_999_995] * 3
        assert read.columns["/state.parts[0].n"].tolist() == [2**64 - 1, 2**64 - 2, 2**64 - 3]
    old = without_definitions(data)
    with pytest.raises(LogError, match=r"'lab_msgs/msg/State' that cannot be read.*ros2 bag convert"):
        frame("db3", old, "/state.lag")


def test_an_old_database_is_read_where_ros_never_changed_the_type(bags):
    old = without_definitions(bags["db3", ""])
    read = frame("db3", old, "/arm/joints.position[1]")
    assert read.columns["/arm/joints.position[1]"].tolist() == samples()[1][:, 1].tolist()


def test_a_database_left_in_journal_mode_is_read(bags):
    data = bytearray(bags["db3", ""])
    data[18:20] = b"\x02\x02"
    assert len(frame("db3", bytes(data), "/command.data")) == 20


def test_other_files_are_refused(bags):
    for kind, name, data, words in (
        ("rosbag", "log.bag", bags["mcap", ""], 'format = "mcap"'),
        ("mcap", "log.mcap", bags["bag", ""], 'format = "rosbag"'),
        ("rosbag", "log.db3", b"\x28\xb5\x2f\xfd" + bytes(20), r"zstd -d log\.db3"),
    ):
        with pytest.raises(LogError, match=words):
            refuse_other_kind(name, kind, data)
    database = sqlite3.connect(":memory:")
    database.execute("CREATE TABLE log (t, x)")
    with pytest.raises(LogError, match="missing tables"):
        frame("db3", bytes(database.serialize()), "/command.data")
    database.close()


def test_lists_of_several_lengths_have_gaps():
    def fill(writer, store, is_ros1):
        floats, layout = store.types["std_msgs/msg/Float64MultiArray"], store.types["std_msgs/msg/MultiArrayLayout"]
        connection = writer.add_connection("/q", floats.__msgtype__, typestore=store)
        for n in range(3):
            message = floats(layout=layout(dim=[], data_offset=0), data=np.arange(3.0 - n))
            writer.write(connection, n, store.serialize_cdr(message, floats.__msgtype__))

    read = frame("mcap", bag_file("mcap", fill), "/q.data[0]", "/q.data[1]", "/q.@received")
    assert read.columns["/q.data[0]"].tolist() == [0.0, 0.0, 0.0]
    np.testing.assert_array_equal(read.columns["/q.data[1]"], [1.0, 1.0, np.nan])
    assert read.columns["/q.@received"].dtype == np.int64
