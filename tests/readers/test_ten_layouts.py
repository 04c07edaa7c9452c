"""Ten layouts of other tools, small and synthetic: each draft asks two questions at most and reads its sample."""

import re
import warnings

import numpy as np
import pytest
from packed_sheets import xlsx
from places import SHARED

from pipeline.profiles.profile_files import find_questions, read_profile
from pipeline.shell.profile.check import check_samples
from pipeline.shell.profile.draft import draft_profile

TIME = np.arange(60) / 1000
FORCE = 0.2 * (np.arange(60) >= 10)
PLACE = 12.5e-3 * np.maximum(TIME - 0.011, 0) ** 2 * 1e3
ROWS = list(zip(TIME.tolist(), FORCE.tolist(), PLACE.tolist(), strict=True))


def quanser(path):
    from nptdms import ChannelObject, TdmsWriter

    with TdmsWriter(path) as writer:
        for number in range(50):
            group = f"Run {number:02d}"
            properties = {"wf_increment": 0.001, "wf_start_offset": 0.0}
            writer.write_segment(
                [
                    ChannelObject(group, "Command", (1 + number / 9) * FORCE, properties=properties),
                    ChannelObject(group, "Position", (1 + number / 9) * PLACE, properties=properties),
                ]
            )


def timeseries(path):
    matio = pytest.importorskip("matio")
    opaque = pytest.importorskip("matio.utils.matclass").MatlabOpaque
    empty = np.zeros((0, 0))

    def series(values):
        one = {"Start_": 0.0, "Increment_": 0.001, "Length": float(len(values))}
        info = {key: np.array([[value]]) for key, value in one.items()} | {"Time_": empty, "Units": "seconds"}
        parts = {"Data_": values[:, None], "Time_": empty, "TimeInfo": opaque(info, "tsdata.timemetadata"), "Name": "x"}
        return opaque(parts, "timeseries")

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        matio.save_to_mat(path, {"F": series(FORCE), "x": series(PLACE)}, version="v7.3")


def structs(path):
    from scipy.io import savemat

    runs = np.zeros(3, dtype=[(name, "O") for name in ("time", "tau", "phi")])
    runs[:] = [(TIME, (1 + i) * FORCE, (1 + i) * PLACE) for i in range(3)]
    savemat(path, {"runs": runs})


def records(path):
    import json

    data = [{"t": t, "u": u, "x": x} for t, u, x in ROWS]
    path.write_text(json.dumps({"rig": "A", "samples": data}))


def rosbag(path):
    from foreign_files import bag_file

    def fill(writer, store, is_ros1):
        kind = store.types["sensor_msgs/msg/JointState"]
        head, stamp = (store.types[n] for n in ("std_msgs/msg/Header", "builtin_interfaces/msg/Time"))
        topic = writer.add_connection("/joint", kind.__msgtype__, typestore=store)
        for t, u, x in ROWS:
            ns = round(1e9 * t)
            header = head(stamp=stamp(sec=1700000000, nanosec=ns), frame_id="a")
            message = kind(header, ["j"], *(np.array([v]) for v in (x, 0.0, u)))
            writer.write(topic, 1700000000 * 10**9 + ns, store.serialize_cdr(message, kind.__msgtype__))

    path.write_bytes(bag_file("mcap", fill))


def labview(path):
    head = ["LabVIEW Measurement", "Separator\tTab", "***End_of_Header***", "", "Channels\t2", "X0\t0.0E+0\t0.0E+0"]
    lines = [*head, "***End_of_Header***", "X_Value\tForce\tPosition\tComment"]
    path.write_text("\n".join([*lines, *(f"{t:.6f}\t{u:.4f}\t{x:.6f}\t" for t, u, x in ROWS), ""]))


def oscilloscope(path):
    rows = [f"{t:.6f},{u:.4f},{x:.6f}" for t, u, x in ROWS]
    path.write_text("\n".join(["Model,DSO-1", "Source,CH1", "Second,Force,Position", "s,N,mm", *rows, ""]))


def plc(path):
    rows = [
        f"29.03.2026 10:00:{t:06.3f};{u:.4f};{x:.6f}".replace(".", ",").replace("29,03,", "29.03.") for t, u, x in ROWS
    ]
    path.write_text("\n".join(["Zeitstempel;Kraft [N];Weg [mm]", *rows, ""]))


def archive(path):
    np.savez(path, t=TIME, u=FORCE, x=PLACE)


def excel(path):
    path.write_bytes(xlsx([["Zeit [s]", "Kraft [N]", "Weg [mm]"], *map(list, ROWS)]))


LAYOUTS = {
    "quanser.tdms": quanser,
    "timeseries.mat": timeseries,
    "structs.mat": structs,
    "records.json": records,
    "bag.mcap": rosbag,
    "labview.lvm": labview,
    "oscilloscope.csv": oscilloscope,
    "plc.csv": plc,
    "archive.npz": archive,
    "sheet.xlsx": excel,
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_layout_of_another_tool_needs_two_answers_at_most(name, tmp_path):
    if name.endswith("xlsx"):
        pytest.importorskip("python_calamine")
    path = tmp_path / name
    LAYOUTS[name](path)
    text = draft_profile(path)
    asked = [".".join(map(str, question.place)) for question in find_questions(text)]
    assert set(asked) <= {"columns.command.unit", "columns.position.unit"}, text
    # Enter for the force; the position in mm, or rad where it turns
    turns = "phi" in text or "joint" in text
    answers = {"columns.command.unit": "Nm" if turns else "N", "columns.position.unit": "rad" if turns else "mm"}
    for place in asked:
        role = place.split(".")[1]
        line = rf"(# QUESTION: columns\.{role}\.unit: .*\n)# unit = .*\n"
        text = re.sub(line, f'unit = "{answers[place]}"\n', text)
    (tmp_path / "lab.toml").write_text(text, encoding="utf-8")
    (sample,) = check_samples(read_profile(tmp_path / "lab.toml"), [path])
    assert sample["reason"] is None
    assert len(sample["trials"]) == {"quanser.tdms": 50, "structs.mat": 3}.get(name, 1)
    columns = {column["column"]: column for column in sample["trials"][0]["columns"]}
    assert columns["command"]["last"] == pytest.approx(0.2)
    scale = 1.0 if turns else 1e-3
    assert columns["position"]["last"] == pytest.approx(scale * PLACE[-1], abs=1e-6 * scale)
    assert columns["time"]["last"] == pytest.approx(0.059, abs=1e-9)


PUBLIC = [
    *("real_numeric_header/run1.csv", "real_numeric_header/blank_after_comment/a.csv", "tdms_start/same.tdms"),
    *(f"json_rows/{name}.json" for name in ("bare_rows", "columns_under_key", "sysid_data", "trials_as_records")),
    *(f"text_headers/{name}" for name in ("box.csv", "iso.csv", "lab.lvm", "quoted.csv")),
]
"""Layouts of public data sets, below the faults that are shared beside the project."""


@pytest.mark.parametrize("name", PUBLIC)
def test_a_public_layout_needs_two_answers_at_most(name):
    path = SHARED / "faults" / name
    if not path.is_file():
        pytest.skip("the shared faults are not here")
    if name.endswith("tdms"):
        pytest.importorskip("nptdms")
    asked = {".".join(map(str, question.place)) for question in find_questions(draft_profile(path))}
    assert asked <= {"columns.command.unit", "columns.position.unit", "columns.time.unit"}
    assert len(asked) <= 2
