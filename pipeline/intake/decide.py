"""Decisions of an ingest: the action for a source, based on the source and the stored data. Nothing here reads or
writes files.

`decide_unread` judges a source by its size and time, before it is opened; `decide` judges one whose content is known.
Each rule has a name; the first that applies decides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pipeline.base.errors import LogError
from pipeline.base.paths import path_of_text
from pipeline.base.wording import counted
from pipeline.intake.quarantine import QuarantineRecord
from pipeline.intake.sources import Source
from pipeline.intake.stored_sources import StoredSource

Rule = Literal[
    "unchanged", "copy", "renamed copy", "new", "renamed", "changed", "profile changed", "completed", "refused before"
]
"""Names of the rules. A copy has the content of another stored source; a renamed copy also has other conditions in its
name. Completed: an interrupted run had stored only some of its trials."""


@dataclass(frozen=True)
class Twin:
    """A source stored under another path, with the same content and the same conditions in its name."""

    path: str
    stored: StoredSource
    exists: bool

    @property
    def name(self) -> str:
        """Name of its file."""
        return path_of_text(self.path).name


@dataclass(frozen=True)
class Evidence:
    """A source whose content is known, and the stored sources that it may repeat or replace.

    Parameters
    ----------
    source : Source
    sha256 : str
        Of its content.
    devices : tuple of str or None
        Devices of its trials; None if it was not parsed because its content is already stored.
    former : StoredSource or None
        Source stored under its path.
    twin : Twin or None
    lost : tuple of (str, StoredSource) or None
        Path and contents of a stored source with this content and profile whose file no longer exists; only if the
        profile reads conditions from names, so that a corrected name does not count as a copy.
    """

    source: Source
    sha256: str
    devices: tuple[str, ...] | None = None
    former: StoredSource | None = None
    twin: Twin | None = None
    lost: tuple[str, StoredSource] | None = None

    @property
    def is_same(self) -> bool:
        """Whether the same content is stored under its path."""
        return self.former is not None and self.former.sha256 == self.sha256


@dataclass(frozen=True)
class Drop:
    """Removal of stored trials of a source stored under ``path``.

    ``outcome`` is reported for the source ``shown``; None if nothing is reported. ``late``: only after new trials are
    stored.
    """

    shown: str
    path: str
    stored: StoredSource
    outcome: str | None = None
    late: bool = False


@dataclass(frozen=True)
class Decision:
    """Decision on a source: the rule, the reason for the report, removals, and a warning."""

    rule: Rule
    reason: str
    drops: tuple[Drop, ...] = ()
    warning: str | None = None

    @property
    def stores(self) -> bool:
        """Whether its trials are stored."""
        return self.rule in ("new", "renamed", "changed", "profile changed", "completed")


def decide_unread(
    source: Source, stored: StoredSource | None, refused: QuarantineRecord | None, *, replace: bool
) -> Decision | None:
    """Return the decision on a source by size, time and profile, or None if its content has to be read.

    A refused source without a hash could not be read, and is tried again: new permissions change neither size nor time.
    With ``replace`` other refused sources are tried again, too.

    Parameters
    ----------
    source : Source
    stored : StoredSource or None
        Source stored under its path.
    refused : QuarantineRecord or None
        Its record in quarantine.
    replace : bool
        Whether trials of another profile or device are replaced.
    """
    state = (source.size, source.mtime_ns, source.profile_sha256)
    former = None if refused is None else (refused.size, refused.mtime_ns, refused.profile_sha256)
    if refused is not None and state == former and refused.sha256 is not None and not replace:
        return Decision("refused before", refused.reason)
    if stored is not None and stored.whole and state == (stored.size, stored.mtime_ns, stored.profile_sha256):
        return Decision("unchanged", "unchanged: size and modification time")
    return None


def decide(evidence: Evidence, *, replace: bool) -> Decision:
    """Return the decision on a source whose content is known.

    Parameters
    ----------
    evidence : Evidence
    replace : bool
        Whether to replace trials of the same content that belong to another profile or device.

    Raises
    ------
    LogError
        If another profile or device has them, and ``replace`` is false.
    """
    twin, former = evidence.twin, evidence.former
    if evidence.devices is None or (twin is not None and twin.stored.profile_sha256 == evidence.source.profile_sha256):
        return _repeated(evidence)
    rival = former if evidence.is_same else twin.stored if twin is not None else None
    replaced = _replaced_rival(evidence, rival, replace=replace)
    if twin is not None and replaced is None and twin.exists:  # another version of the profile read it
        return _repeated(evidence)
    shown, key = evidence.source.shown, evidence.source.key
    drops = () if twin is None else (Drop(shown, twin.path, twin.stored, replaced),)
    if former is None:
        return _new(evidence, drops)
    if not evidence.is_same:
        outcome = "its trials were replaced by those of the new content"
        late = evidence.source.mtime_ns > former.mtime_ns
        return Decision("changed", "content changed", (*drops, Drop(shown, key, former, outcome, late)))
    if former.profile_sha256 != evidence.source.profile_sha256:
        return Decision("profile changed", "profile changed", (*drops, Drop(shown, key, former, replaced)))
    return Decision("completed", "stored in part, by an interrupted run", drops)


def _repeated(evidence: Evidence) -> Decision:
    """Return the decision on a source whose content is stored, under its path or another one."""
    source, twin, former = evidence.source, evidence.twin, evidence.former
    if twin is None:
        return Decision("unchanged", "unchanged content")
    drops: tuple[Drop, ...] = ()
    if former is not None:
        outcome = f"its content is now that of {twin.path}; its former trials were removed"
        if evidence.is_same:
            outcome = f"{twin.path} now has the same content; its trials are stored as those of that log"
        drops = (Drop(source.shown, source.key, former, outcome),)
    reason = f"same content as {twin.path}"
    if source.profile is not None and source.profile.reads_names and twin.name != source.path.name:
        text = f"has the content of {twin.path} under another name; left out. Remove the one that is wrong."
        return Decision("renamed copy", reason, drops, text)
    return Decision("copy", reason, drops)


def _new(evidence: Evidence, drops: tuple[Drop, ...]) -> Decision:
    """Return the decision on a source whose path is not stored: new, or a lost source under a corrected name."""
    source = evidence.source
    if evidence.lost is None:
        return Decision("new", "new", drops)
    path, stored = evidence.lost
    lost = Drop(path, path, stored, f"is now {source.shown}; its trials were read again")
    return Decision("renamed", f"its name was {path}", (*drops, lost))


def _replaced_rival(evidence: Evidence, rival: StoredSource | None, *, replace: bool) -> str | None:
    """Return the report on replaced trials with the same content but another profile or device, or None.

    Raises
    ------
    LogError
        If there are such trials, and ``replace`` is false.
    """
    assert evidence.source.profile is not None, "a source without a profile is refused before it is read"
    profile, devices = evidence.source.profile.name, sorted(set(evidence.devices or ()))
    if rival is None or (rival.profile, sorted(set(rival.devices))) == (profile, devices):
        return None
    before = f"device {', '.join(map(repr, sorted(set(rival.devices))))} by profile {rival.profile!r}"
    if not replace:
        raise LogError(
            f"is stored as a log of {before}, but profile {profile!r} now claims it for device "
            f"{', '.join(map(repr, devices))}. Its trials stay as they are. To read it as that now, delete them or "
            "give --replace; or name the right profile.",
            code="profile-wrong",
        )
    count = len(rival.trials)
    return f"{counted(count, 'trial')} of {before} {'was' if count == 1 else 'were'} replaced"
