"""Log profiles: how the files of one lab map to SI columns, described in TOML and checked when read.

Shipped profiles lie in ``schemas/profiles``; a user's own is given by file name. A profile names the files
it claims, the partner file where one log is two files, the columns with their units and signs, and the
conditions that the files themselves do not state. `pipeline.profiles.profile_model` describes the keys.
"""

from __future__ import annotations

import tomllib
from functools import cache
from pathlib import Path

from pipeline.base.errors import ProfileError
from pipeline.base.provenance import schema_folder
from pipeline.profiles.profile_lines import find_mistakes, find_questions
from pipeline.profiles.profile_model import Profile

__all__ = ["Profile", "claim", "load_profile", "read_profile", "shipped_profiles"]


def read_profile(path: Path) -> Profile:
    """Read and check a profile.

    Raises
    ------
    ProfileError
        If the file cannot be read, is no TOML, has wrong, missing or unknown keys, or questions of a draft that are
        still open: all of them, each with file, line and key.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
        values = tomllib.loads(text)
    except OSError as error:
        raise ProfileError(f"{path}: profile cannot be read: {error.strerror}.") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ProfileError(f"{path}: profile is no valid TOML (UTF-8): {error}.") from error
    questions = find_questions(text)
    asked = {question.place for question in questions}
    # a key that is asked for is not missing, too
    wrong = [mistake for mistake in find_mistakes(values, text) if mistake.place not in asked]
    found = sorted((*questions, *wrong), key=lambda mistake: mistake.line)
    if found:
        kinds = " and ".join(kind for kind, some in (("mistakes", wrong), ("open questions", questions)) if some)
        count = f"{len(found)} {kinds} in this profile:\n" if len(found) > 1 else ""
        raise ProfileError(count + "\n".join(f"{path}:{mistake.line}: {mistake.text}" for mistake in found))
    return Profile.model_validate(values)


@cache
def shipped_profiles() -> tuple[Profile, ...]:
    """Return the profiles that come with the package, sorted by name."""
    return tuple(read_profile(path) for path in sorted((schema_folder() / "profiles").glob("*.toml")))


def load_profile(profile: str | Path) -> Profile:
    """Return a profile by the name of a shipped one or by its TOML file.

    Raises
    ------
    ProfileError
        If there is no such name or file, or the file is wrong.
    """
    shipped = {p.name: p for p in shipped_profiles()}
    if str(profile) in shipped:
        return shipped[str(profile)]
    path = Path(profile)
    if path.is_file():
        return read_profile(path)
    raise ProfileError(
        f"profile {str(profile)!r} is neither a file nor a shipped profile; expected one of "
        f"{sorted(shipped)} or the path of a TOML file."
    )


def claim(name: str, profiles: tuple[Profile, ...]) -> Profile | None:
    """Return the profile that claims a log by its file name; a specific one goes before the native one.

    Raises
    ------
    ProfileError
        If two profiles that are not native claim it.
    """
    specific = [p for p in profiles if p.format != "native" and p.claims(name)]
    if len(specific) > 1:
        raise ProfileError(
            f"{name}: claimed by the profiles {[p.name for p in specific]}; expected one. "
            "Choose with --profile, or narrow the `files` patterns."
        )
    if specific:
        return specific[0]
    return next((p for p in profiles if p.format == "native" and p.claims(name)), None)
