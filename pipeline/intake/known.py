"""What logs are known already, and by what: content, with what the profile reads from the name; and whose they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set

from pipeline.base.errors import LogError
from pipeline.base.file_names import path_of_text
from pipeline.base.regular_files import is_gone
from pipeline.intake.sources import Source, content_of, identity
from pipeline.intake.versions import StoredSource, StoredSources
from pipeline.profiles.profile_model import Profile
from pipeline.readers import Log


class Known:
    """Logs that are stored, by what they are (`sources.identity`): by which profile, under which path.

    Parameters
    ----------
    digests : mapping of Profile to str
        Hash of each profile that is at hand.
    """

    def __init__(self, digests: Mapping[Profile, str]) -> None:
        self.profiles = dict(zip(digests.values(), digests, strict=True))
        self.profile_of: dict[str, str] = {}
        self.place: dict[str, str] = {}
        self.gone: dict[str, str] = {}
        """Hash of a content -> path where it stood, and nothing stands any more."""

    def fill(self, stored: StoredSources, but: Set[str], present: Set[str]) -> None:
        """Take all that is stored but some; `present` are the paths of all that was found."""
        self.place, self.profile_of = stored.whole(but, self.identity)
        away = [(one, path) for one, path in self.place.items() if path not in present]
        self.gone = {content_of(one): path for one, path in away if is_gone(path_of_text(path))}

    def identity(self, sha256: str, profile_sha256: str, path: str) -> str:
        """Return what a stored log is; one of a profile that is not at hand is its content."""
        profile = self.profiles.get(profile_sha256)
        return sha256 if profile is None else identity(sha256, profile, path)

    def unread(self, profile: Profile | None) -> Mapping[str, str]:
        """Return the logs that need not be read, for sources of a profile; a name that was corrected is read anew."""
        if not self.gone or profile is None or not profile.reads_names:
            return self.profile_of
        # other threads add to it
        return {one: digest for one, digest in self.profile_of.copy().items() if content_of(one) not in self.gone}

    def find(self, sha256: str, one: str) -> tuple[str | None, str | None]:
        """Return the profile's hash and the path of a log; one of a profile that is not at hand is found, too."""
        own = one if one in self.profile_of else sha256
        return self.profile_of.get(own), self.place.get(own)

    def add(self, one: str, profile_sha256: str, path: str) -> None:
        """Take a log."""
        self.profile_of[one], self.place[one] = profile_sha256, path


def outcome_for(former: StoredSource, source: Source, sha256: str, logs: Sequence[Log], replace: bool) -> str | None:
    """Return what becomes of the stored trials of a source that is read now; None where they are read anew.

    Raises
    ------
    LogError
        If the same bytes are of another device by now, whose trials would be removed without being asked for.
    """
    now = {log.header.device for log in logs}
    trials = f"{len(former.trials)} trial{'s' if len(former.trials) > 1 else ''}"
    claims = f"{trials} of device {_names(former.devices)}, read by profile {former.profile}"
    reader = f"device {_names(now)}"
    if former.sha256 != sha256:
        more = "" if former.devices <= now else f"; these were {claims}, now they are of {reader}"
        return f"its trials were replaced by those of the new content{more}"
    if former.devices <= now:
        return None
    if replace:
        return f"{claims}, were replaced by those of {reader}"
    by = "" if source.profile is None else f", read by profile {source.profile.name}"
    raise LogError(
        f"{source.path.name} is stored as {claims}; now it would be {reader}{by}. Correct the profile, or give "
        "--replace: the stored trials then give way.",
        code="condition-wrong",
    )


def _names(devices: Set[str]) -> str:
    return ", ".join(map(repr, sorted(devices)))
