"""Reads delimited text (CSV, TSV, ...) with a line of column names, as a profile describes it."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv

from pipeline.batch import Floats
from pipeline.errors import LogError, ProfileError
from pipeline.native import NativeHeader, parse_header
from pipeline.profiles import Profile
from pipeline.readers import Log, Outcome, RawLog, check_samples


def read(profile: Profile, raws: Sequence[RawLog], use_threads: bool) -> list[Outcome]:
    """Read logs of one or two delimited files each.

    Parameters
    ----------
    profile : Profile
        A profile of format ``delimited``.
    raws : sequence of RawLog
    use_threads : bool
        Whether parsing may use several processors.

    Returns
    -------
    list of Log or LogError
        In the order given.
    """
    outcomes: list[Outcome] = []
    for raw in raws:
        try:
            outcomes.append(_read_log(profile, raw, use_threads))
        except LogError as error:
            outcomes.append(error)
        except ProfileError as error:
            # one file that does not fit must not stop the others
            outcomes.append(LogError(str(error), profile.skip_rows + 1))
    return outcomes


def _read_log(profile: Profile, raw: RawLog, use_threads: bool) -> Log:
    header = header_of(profile, raw.names[0])
    sources = profile.column_sources()
    columns: dict[str, Floats] = {}
    for which, name, data in zip(("source", "partner"), raw.names, raw.data, strict=False):
        wanted = {key: source.name for key, source in sources.items() if source.file == which}
        if wanted:
            columns |= _read_columns(profile, name, data, wanted, use_threads)
    lengths = {key: len(values) for key, values in columns.items()}
    if len(set(lengths.values())) > 1:
        raise LogError(
            f"the files {' and '.join(raw.names)} have different numbers of rows ({lengths}); expected "
            "the same, row for row. Were they recorded together?",
            profile.skip_rows + 2 + min(lengths.values()),
        )
    for key, factor in profile.factors().items():
        if factor != 1.0:
            columns[key] = columns[key] * factor
    return check_samples(header, first_row=profile.skip_rows + 2, **columns)


def header_of(profile: Profile, name: str) -> NativeHeader:
    """Return the conditions of a log from the profile's constants and the file name.

    Raises
    ------
    LogError
        If the file name does not fit the profile's `name_pattern`, or a condition is not legal.
    """
    given = {key: value for key, value in profile.constants.model_dump().items() if value is not None}
    if profile.name_pattern is not None:
        match = re.search(profile.name_pattern, name)
        if match is None:
            raise LogError(
                f"file name {name!r} does not fit name_pattern {profile.name_pattern!r} of {profile.name}. "
                "Rename the file or correct the profile."
            )
        given |= {key: value for key, value in match.groupdict().items() if value is not None}
    try:
        # as native header lines, so that the conditions of every format pass the same checks
        header = parse_header(f"# {key}: {value}" for key, value in given.items())
    except LogError as error:
        raise LogError(f"{name}: by the constants and name_pattern of {profile.name}, {error.reason}") from error
    if (header.device, header.experiment) != (given["device"], given["experiment"]):
        raise LogError(
            f"{name}: device {given['device']!r} or experiment {given['experiment']!r} would be stored as "
            f"{header.device!r}, {header.experiment!r}. Choose names without brackets."
        )
    return header if profile.step_row is None else replace(header, extra={"step_row": str(profile.step_row)})


def _read_columns(
    profile: Profile, name: str, data: bytes, wanted: dict[str, str], use_threads: bool
) -> dict[str, Floats]:
    text = data.removeprefix(b"\xef\xbb\xbf").rstrip() + b"\n"
    lines = text.split(b"\n", profile.skip_rows + 1)
    if len(lines) < profile.skip_rows + 2:
        raise LogError(f"{name} is empty; expected a line of column names and samples.", 1)
    try:
        names = [n.strip() for n in next(csv.reader([lines[-2].decode()], delimiter=profile.delimiter), [])]
    except UnicodeDecodeError as error:
        raise LogError(f"{name} is no UTF-8 text ({error.reason}).", profile.skip_rows + 1) from error
    for key, column in wanted.items():
        if names.count(column) != 1:
            raise ProfileError(
                f"{name}: profile {profile.name} wants column {column!r} for columns.{key} once, "
                f"found it {names.count(column)} times among {names}. Correct the profile or the file."
            )
    positions = {key: names.index(column) for key, column in wanted.items()}
    body = lines[-1]
    if not body.strip():
        return {key: np.empty(0) for key in wanted}
    labels = [str(i) for i in range(len(names))]
    taken = [labels[i] for i in positions.values()]
    try:
        table = pacsv.read_csv(
            pa.BufferReader(body),
            read_options=pacsv.ReadOptions(column_names=labels, use_threads=use_threads),
            parse_options=pacsv.ParseOptions(delimiter=profile.delimiter, ignore_empty_lines=False),
            convert_options=pacsv.ConvertOptions(
                column_types=dict.fromkeys(taken, pa.float64()),
                include_columns=sorted(set(taken)),
                null_values=[],
                strings_can_be_null=False,
                decimal_point=profile.decimal,
            ),
        )
    except pa.ArrowInvalid as error:
        raise _fault(profile, name, body, positions, len(names), str(error)) from error
    return {key: table.column(labels[i]).to_numpy() for key, i in positions.items()}


def _fault(profile: Profile, name: str, body: bytes, positions: dict[str, int], width: int, message: str) -> LogError:
    """Return the error that names the row and cell at which a file cannot be read."""
    first = profile.skip_rows + 2
    reader = csv.reader(body.decode("utf-8", "replace").splitlines(), delimiter=profile.delimiter)
    for row, cells in enumerate(reader, start=first):
        if len(cells) != width:
            return LogError(f"{name}: expected {width} values, found {len(cells)}. Repair the row.", row)
        for key, index in positions.items():
            try:
                float(cells[index].replace(profile.decimal, ".").replace("_", "?"))
            except ValueError:
                return LogError(
                    f"{name}: {key} must be a number (decimal sign {profile.decimal!r}), found "
                    f"{cells[index][:200]!r}. Repair the row, or leave this log out.",
                    row,
                )
    return LogError(f"{name} cannot be read as delimited text: {message}.", first)
