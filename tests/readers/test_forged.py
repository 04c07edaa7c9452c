"""Forged HDF5 files are refused before they cost time and memory, by what they claim and by what may be unpacked."""

import json
import subprocess
import sys
import zlib

import h5py
import numpy as np
import pytest

MEBIBYTES, SECONDS = 500, 2.0
"""Peak of the worker that reads, and its processor time; importing the libraries takes 60 MiB and 0.4 s of it,
three times what the file may unpack to (30 times its 4 MiB) the rest."""

READ = """
import json, resource, sys
from pathlib import Path
from pipeline.base.errors import LogError
from pipeline.readers import isolation
from pipeline.profiles.profile_model import Profile
from pipeline.readers.isolation import read_file
data = Path(sys.argv[1]).read_bytes()
codes = []
for wanted in (("t",), ()):
    try:
        profile = Profile.model_construct(name="lab", format="hdf5", files=("*",))
        read_file(profile, ("forged",), (data,), wanted).frame()
        codes.append(None)
    except LogError as error:
        codes.append(error.code)
    while isolation._IDLE:
        isolation._IDLE.pop().end()
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps([codes, used.ru_maxrss / 1024, (used.ru_utime + used.ru_stime) / 2]))
"""


def zeros(mebibytes):
    packer = zlib.compressobj(1)
    return b"".join(packer.compress(bytes(1 << 20)) for _ in range(mebibytes)) + packer.flush()


def one_value_of_a_huge_chunk(file):
    data = file.create_dataset("one", (1,), maxshape=(None,), chunks=(400_000_000,), dtype="f8", compression="gzip")
    data.id.write_direct_chunk((0,), zeros(900))


def a_chunk_that_unpacks_to_more_than_it_claims(file):
    data = file.create_dataset("one", (1,), maxshape=(None,), chunks=(1,), dtype="f8", compression="gzip")
    data.id.write_direct_chunk((0,), zeros(900))


def dimensions_without_end(file):
    file.create_dataset("one", (10**15,), dtype="f8", chunks=(1000,))


def many_columns_of_nothing(file):
    for number in range(300):
        file.create_dataset(f"c{number}", (8_000_000,), dtype="f8", chunks=(8_000_000,), compression="gzip")


def values_of_another_file(file):
    layout = h5py.VirtualLayout((10**9,), dtype="f8")
    layout[:] = h5py.VirtualSource("/etc/hostname", "x", (10**9,))
    file.create_virtual_dataset("one", layout)


def groups_without_end(file):
    group = file
    for _ in range(1500):
        group = group.create_group("g")
    group["back"] = file["/"]


FORGED = {
    one_value_of_a_huge_chunk: None,
    a_chunk_that_unpacks_to_more_than_it_claims: None,
    dimensions_without_end: None,
    many_columns_of_nothing: None,
    values_of_another_file: None,
    groups_without_end: "damaged",
}
"""By what the file is refused where a sound column of it is wanted; None where that is read."""


@pytest.mark.sampled
@pytest.mark.parametrize("forge", FORGED, ids=lambda forge: forge.__name__)
def test_a_forged_file_costs_little(tmp_path, forge):
    with h5py.File(tmp_path / "forged.h5", "w", libver="latest") as file:
        file["t"] = np.arange(100) * 1e-3
        forge(file)
    done = subprocess.run(
        [sys.executable, "-c", READ, str(tmp_path / "forged.h5")], capture_output=True, text=True, check=True
    )
    (wanted, _), mebibytes, seconds = json.loads(done.stdout)
    assert wanted == FORGED[forge]
    assert mebibytes < MEBIBYTES
    assert seconds < SECONDS
