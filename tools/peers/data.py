"""Reads trials of one or several sources, and splits them into the folds of `surfaced eval`."""

import re
import tomllib
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.io import wavfile

LMT108_NAME = re.compile(r"(?P<surface>.+)_Sound_Movement_train(?P<number>\d+)\.wav", re.IGNORECASE)
EXPERT = "expert"
EXPERT_VS_USERS = "expert-vs-users"
ALL_VS_ONE_USER = "all-vs-one-user"
LEAVE_ONE_TRIAL_OUT = "leave-one-trial-out"
PROTOCOLS = (LEAVE_ONE_TRIAL_OUT, EXPERT_VS_USERS, ALL_VS_ONE_USER)

Signals = tuple[np.ndarray, ...]  # one for each source: shape (channels, samples), float32


class DataError(Exception):
    """What is wrong with the data, for people."""


@dataclass(frozen=True)
class Trial:
    surface: str
    user: str
    number: int
    path: Path  # a folder, or LMT108's sound
    signals: Signals  # full scale is 1 where the file holds integers


@dataclass(frozen=True)
class Data:
    sources: list[str]
    rates_hz: list[int]  # of each source
    trials: list[Trial]  # sorted by surface, user, number

    def surfaces(self) -> list[str]:
        return sorted({trial.surface for trial in self.trials})

    def lengths(self) -> np.ndarray:
        """Samples, shape (trials, sources)."""
        return np.array([[x.shape[1] for x in trial.signals] for trial in self.trials])


@dataclass(frozen=True)
class Fold:
    name: str  # the user or the trial that is left out
    library: list[int]
    queries: list[int]


def load(root: Path, only: list[str] | None = None) -> Data:
    """All trials below `root`, with some of their sources or with all."""
    if not root.is_dir():
        raise DataError(f"{root}: no such folder")
    found = _lmt108(root)
    if found:
        sources = _narrowed(["mi2"], only, root)
        files = {key: [path] for key, path in found.items()}
    else:
        found = _recordings(root)
        sources = _narrowed(_sources(root, found.values()), only, root)
        files = {key: [path / f"{name}.wav" for name in sources] for key, path in found.items()}
    trials, rates_hz = [], None
    for key, paths in sorted(files.items()):
        rates, signals = zip(*(_read(path) for path in paths), strict=True)
        if rates != (rates_hz := rates_hz or rates):
            raise DataError(f"{found[key]}: {rates} Hz; other trials have {rates_hz} Hz")
        trials.append(Trial(*key, found[key], signals))
    return Data(sources, list(rates_hz), trials)


def _narrowed(held: list[str], only: list[str] | None, root: Path) -> list[str]:
    if missing := set(only or ()) - set(held):
        raise DataError(f"{root}: no source {sorted(missing)}; it has {held}")
    return [name for name in held if only is None or name in only]


def _sources(root: Path, folders) -> list[str]:
    """Those that library.toml names, without pictures; without it, those that every trial has."""
    toml = root / "library.toml"
    if toml.is_file() and (named := _toml(toml).get("sources")):
        return [name for name, source in named.items() if source.get("domain") != "image"]
    return sorted(set.intersection(*({wav.stem for wav in f.glob("*.wav")} for f in folders)))


def _lmt108(root: Path) -> dict[tuple[str, str, int], Path]:
    found = {}
    for base in (root, *sorted(path for path in root.iterdir() if path.is_dir())):
        for path in sorted((base / "SoundScans" / "Movement" / "Training").glob("*")):
            if match := LMT108_NAME.fullmatch(path.name):
                _add(found, match["surface"], EXPERT, int(match["number"]), path)
    return found


def _recordings(root: Path) -> dict[tuple[str, str, int], Path]:
    found = {}
    for folder in sorted({path.parent for path in root.glob("*/*/*.wav")}):
        toml = folder / "trial.toml"
        said = _toml(toml) if toml.is_file() else {}
        number = said.get("trial")
        if number is None:
            digits = re.search(r"\d+$", folder.name)
            if not digits:
                raise DataError(f"{folder}: the folder's name does not end with a number")
            number = int(digits[0])
        surface = said.get("surface", folder.parent.name)
        _add(found, surface, said.get("user", EXPERT), number, folder)
    if not found:
        raise DataError(
            f"{root}: nothing found; expected SoundScans/Movement/Training/"
            "S_Sound_Movement_trainN.wav, or SURFACE/TRIAL/SOURCE.wav"
        )
    return found


def _toml(path: Path) -> dict:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: {error}") from error


def _add(found: dict, surface: str, user: str, number: int, path: Path) -> None:
    other = found.setdefault((surface, user, number), path)
    if other != path:
        raise DataError(f"{other} and {path} are both trial {number} of {surface} by {user}")


def _read(path: Path) -> tuple[int, np.ndarray]:
    try:
        with warnings.catch_warnings():  # chunks that scipy does not know are no fault
            warnings.simplefilter("ignore", wavfile.WavFileWarning)
            rate_hz, samples = wavfile.read(path)
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: {error}") from error
    if len(samples) == 0:
        raise DataError(f"{path}: no samples in it")
    if np.issubdtype(samples.dtype, np.signedinteger):
        samples = samples / -float(np.iinfo(samples.dtype).min)  # 24 bits come as 32
    elif not np.issubdtype(samples.dtype, np.floating):
        raise DataError(f"{path}: {samples.dtype}; expected 16-bit, 24-bit or float samples")
    samples = np.ascontiguousarray(np.atleast_2d(samples.T), np.float32)
    if not np.isfinite(samples).all():
        raise DataError(f"{path}: NaN or infinite samples")
    return rate_hz, samples


def folds(trials: list[Trial], protocol: str = LEAVE_ONE_TRIAL_OUT) -> list[Fold]:
    """Each user's trials against the expert's or against everybody else's, or trial k of every
    surface against the other trials, of the expert's alone. Queries whose surface is not in the
    library are left out, and folds without queries."""
    result = []
    for name, in_library, is_query in _splits(trials, protocol):
        library = [i for i, trial in enumerate(trials) if in_library(trial)]
        known = {trials[i].surface for i in library}
        queries = [i for i, t in enumerate(trials) if is_query(t) and t.surface in known]
        if queries:
            result.append(Fold(name, library, queries))
    if not result or any(len({trials[i].surface for i in f.library}) < 2 for f in result):
        raise DataError(f"{protocol}: each query needs a library of two surfaces or more")
    return result


def _splits(trials: list[Trial], protocol: str):
    """Name, what is in the library, and what is a query, for each fold."""
    if protocol == LEAVE_ONE_TRIAL_OUT:
        for k in sorted({trial.number for trial in trials if trial.user == EXPERT}):
            yield (
                f"trial {k}",
                lambda t, k=k: t.user == EXPERT and t.number != k,
                lambda t, k=k: t.user == EXPERT and t.number == k,
            )
        return
    for user in sorted({trial.user for trial in trials}):
        if protocol != EXPERT_VS_USERS:
            yield user, lambda t, u=user: t.user != u, lambda t, u=user: t.user == u
        elif user != EXPERT:
            yield user, lambda t: t.user == EXPERT, lambda t, u=user: t.user == u
