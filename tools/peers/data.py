"""Reads the dragging sounds of the expert's trials, and splits them into the folds of
`surfaced eval --protocol leave-one-trial-out`."""

import re
import tomllib
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.io import wavfile

LMT108_NAME = re.compile(r"(?P<surface>.+)_Sound_Movement_train(?P<number>\d+)\.wav", re.IGNORECASE)


class DataError(Exception):
    """What is wrong with the data, for people."""


@dataclass(frozen=True)
class Trial:
    surface: str
    number: int
    path: Path
    rate_hz: int
    samples: np.ndarray  # float32, full scale is 1


@dataclass(frozen=True)
class Fold:
    name: str
    library: list[int]
    queries: list[int]


def load(root: Path) -> list[Trial]:
    """The trials of a library, sorted by surface, then number."""
    if not root.is_dir():
        raise DataError(f"{root}: no such folder")
    found = _lmt108(root) or _recordings(root)
    if not found:
        raise DataError(
            f"{root}: no dragging sound found; expected SoundScans/Movement/Training/"
            "S_Sound_Movement_trainN.wav, or SURFACE/TRIAL/mi2.wav"
        )
    trials = [Trial(*key, path, *_read(path)) for key, path in sorted(found.items())]
    rates = {trial.rate_hz for trial in trials}
    if len(rates) > 1:
        raise DataError(f"{root}: different rates, {sorted(rates)} Hz; the peers need one")
    return trials


def _lmt108(root: Path) -> dict[tuple[str, int], Path]:
    found = {}
    for base in (root, *sorted(path for path in root.iterdir() if path.is_dir())):
        for path in sorted((base / "SoundScans" / "Movement" / "Training").glob("*")):
            if match := LMT108_NAME.fullmatch(path.name):
                _add(found, match["surface"], int(match["number"]), path)
    return found


def _recordings(root: Path) -> dict[tuple[str, int], Path]:
    found = {}
    for path in sorted(root.glob("*/*/mi2.wav")):
        said = {}
        toml = path.with_name("trial.toml")
        if toml.is_file():
            try:
                said = tomllib.loads(toml.read_text(encoding="utf-8"))
            except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
                raise DataError(f"{toml}: {error}") from error
        if said.get("user", "expert") != "expert":
            continue
        number = said.get("trial")
        if number is None:
            digits = re.search(r"\d+$", path.parent.name)
            if not digits:
                raise DataError(f"{path.parent}: the folder's name does not end with a number")
            number = int(digits[0])
        _add(found, said.get("surface", path.parent.parent.name), number, path)
    return found


def _add(found: dict, surface: str, number: int, path: Path) -> None:
    other = found.setdefault((surface, number), path)
    if other != path:
        raise DataError(f"{other} and {path} are both trial {number} of {surface}")


def _read(path: Path) -> tuple[int, np.ndarray]:
    try:
        with warnings.catch_warnings():  # chunks that scipy does not know are no fault
            warnings.simplefilter("ignore", wavfile.WavFileWarning)
            rate_hz, samples = wavfile.read(path)
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: {error}") from error
    if samples.ndim != 1 or len(samples) == 0:
        raise DataError(f"{path}: shape {samples.shape}; expected one channel with samples in it")
    if np.issubdtype(samples.dtype, np.signedinteger):
        samples = samples / -float(np.iinfo(samples.dtype).min)  # 24 bits come as 32
    elif not np.issubdtype(samples.dtype, np.floating):
        raise DataError(f"{path}: {samples.dtype}; expected 16-bit, 24-bit or float samples")
    samples = samples.astype(np.float32)
    if not np.isfinite(samples).all():
        raise DataError(f"{path}: NaN or infinite samples")
    return rate_hz, samples


def folds(trials: list[Trial]) -> list[Fold]:
    """Fold k: trial k of every surface against all other trials. Queries whose surface is not in
    the library are left out, and folds without queries."""
    result = []
    for number in sorted({trial.number for trial in trials}):
        library = [i for i, trial in enumerate(trials) if trial.number != number]
        known = {trials[i].surface for i in library}
        queries = [
            i for i, t in enumerate(trials) if t.number == number and t.surface in known
        ]
        if queries:
            result.append(Fold(f"trial {number}", library, queries))
    if not result or any(len({trials[i].surface for i in f.library}) < 2 for f in result):
        raise DataError("leave-one-trial-out needs two trials or more of two surfaces or more")
    return result
