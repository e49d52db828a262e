"""Policies that other programs trained, behind the same interface as those trained here.

| spec | policy |
|---|---|
| `torchscript:FILE.pt` | a TorchScript module, as d3rlpy's `save_policy("FILE.pt")` writes it |
| `onnx:FILE.onnx` | an ONNX graph of one input; external weights lie in `FILE.onnx.data` |
| `d3rlpy:FILE.d3` | a d3rlpy model, run in a separate process by a Python that has d3rlpy |
| `command:WORDS …` | any program that speaks the protocol of `zest_rl.agents.child` |
| `NAME:REST` | an entry point of another package (group `zest_rl.policies`): a function from REST to a callable |

All of them map raw observations (N, obs_dim), as in the dataset, to actions (N, act_dim) in [-1, 1]. Of several outputs
of TorchScript or ONNX the first are the actions; weights in double get double. If a callable or a TorchScript module
has a method `begin(n_episodes)`, it is called when N new episodes start.

Nothing is unpickled in this process; but TorchScript, ONNX, commands and packages run their authors' code, and d3rlpy
unpickles its models in its own process. So `load` wants each to be trusted (`zest_rl.runtime.trust`).
"""

from __future__ import annotations

import importlib.metadata
import operator
import shlex
import shutil
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray

from zest_rl.agents.base import check_obs
from zest_rl.agents.child import PolicyProcess
from zest_rl.agents.configs import FOREIGN
from zest_rl.errors import BadInput, ZestError, nearest
from zest_rl.runtime.artifacts import hash_file
from zest_rl.runtime.files import user_path
from zest_rl.runtime.records import from_json, reading_record
from zest_rl.runtime.trust import check_trusted
from zest_rl.types import FloatArray

ENTRY_POINTS = "zest_rl.policies"
FAMILIES = ("torchscript", "onnx", "d3rlpy", "command")
POLICY_FOLDER = "policy"
"""Folder of a run that holds copies of the policy's files."""
TOLERANCE = 1e-5
"""An action may leave [-1, 1] by this much before it counts as clipped."""

Act = Callable[[FloatArray], Any]


# -------------------------------------------------------------------------------------------------------- identity


@dataclass(frozen=True)
class PolicyIdentity:
    """What defines a policy; policies with equal files have equal identities, whatever their paths."""

    family: str
    """One of `FAMILIES`, or a name that another package registered."""
    words: tuple[str, ...]
    """A file of the run (``policy/FILE``), the words of a command, or the text after ``NAME:``."""
    files: Mapping[str, str]
    """Path (from the run's folder, or absolute) → sha256 of each file that the policy consists of, as far as known."""
    code: str = ""
    """Entry point and version of the other package."""
    originals: Mapping[str, Path] = field(default_factory=dict)
    """Path in the run's folder → the file to be copied there."""

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """Read what `to_json` returned; raises as `zest_rl.runtime.records.from_json`."""
        identity = from_json(cls, {**values, "words": tuple(values["words"])})
        texts = (*identity.words, *identity.files, *identity.files.values())
        if not identity.words or not all(isinstance(text, str) for text in texts):
            raise TypeError("the words and files of a policy must be strings")
        return identity

    def to_json(self) -> dict[str, Any]:
        """What the run's ``meta.json`` holds as ``policy``."""
        return {"family": self.family, "words": list(self.words), "files": dict(self.files), "code": self.code}

    def what_runs(self) -> str:
        """Say what acting with it runs."""
        if self.family in ("command", "d3rlpy"):
            return f"runs the program {shlex.join(self.words)}"
        if self.family in FAMILIES:
            return f"runs the code in {self.words[0]} ({self.family})"
        return f"calls {self.code} with {self.words[0]!r}"


def parse(spec: str, python: str | None = None) -> tuple[str, str]:
    """Split a spec (see the table above) into family and rest; no file needs to be there yet.

    Raises:
        BadInput: unknown family, nothing after the colon, or a Python that is missing or superfluous.
    """
    family, _, rest = spec.partition(":")
    known = (*FAMILIES, *_registered())
    if family not in known:
        raise BadInput(f"unknown kind of policy {family!r}; {nearest(family, known)}")
    if not rest.strip() and family in FAMILIES:
        raise BadInput(f"{family}: must be followed by {'a command' if family == 'command' else 'a file'}, got nothing")
    if (python is not None) != (family == "d3rlpy"):
        raise BadInput(
            f"a Python belongs to d3rlpy:FILE.d3 and to nothing else, got {python!r} with {family}:; "
            "give --python /path/to/bin/python of the environment that has d3rlpy"
        )
    return family, rest


def identify(spec: str, python: str | None = None) -> PolicyIdentity:
    """Resolve a spec (see the table above) and hash the policy's files; nothing is run.

    Args:
        spec: the policy.
        python: for ``d3rlpy:``, the Python that has d3rlpy.

    Raises:
        BadInput: `parse` refuses the spec, or a file or the Python is missing.
    """
    family, rest = parse(spec, python)
    if family == "command":
        words = tuple(_absolute(word) for word in _split(rest))
        return PolicyIdentity(family, words, _hash_files(words))
    if family not in FAMILIES:
        entry = _registered()[family]
        words = (_absolute(rest),)
        version = entry.dist.version if entry.dist is not None else "unknown"
        return PolicyIdentity(family, words, _hash_files(words), code=f"{entry.value} {version}")
    path = user_path(rest)
    if not path.is_file():
        raise BadInput(f"there is no file {path}; give what the training program saved")
    weights = path.with_name(f"{path.name}.data")  # where torch's exporter puts external weights
    parts = [path, weights] if family == "onnx" and weights.is_file() else [path]
    originals = {f"{POLICY_FOLDER}/{part.name}": part for part in parts}
    program = () if python is None else (_find_program(python),)
    return PolicyIdentity(
        family,
        (*program, f"{POLICY_FOLDER}/{path.name}"),
        {place: hash_file(part) for place, part in originals.items()},
        originals=originals,
    )


def _registered() -> dict[str, importlib.metadata.EntryPoint]:
    return {entry.name: entry for entry in importlib.metadata.entry_points(group=ENTRY_POINTS)}


def _split_path(word: str) -> tuple[str, Path | None]:
    """Split ``--flag=PATH`` into ``--flag=`` and the absolute path; None when the word names no file or folder."""
    flag, equals, value = word.rpartition("=") if word.startswith("-") else ("", "", word)
    try:
        path = user_path(value)
        is_path = path.is_file() or (path.is_dir() and "/" in value)  # a plain word may be a sub-command
        return flag + equals, path.absolute() if is_path else None  # not resolved: a venv's python is a link
    except (OSError, RuntimeError):  # a name that is too long, or the home of an unknown user
        return "", None


def _absolute(word: str) -> str:
    """Make the path in a word absolute; leave other words alone."""
    flag, path = _split_path(word)
    return word if path is None else f"{flag}{path}"


def _hash_files(words: Sequence[str]) -> dict[str, str]:
    """Hash the files that the words of a command name.

    Raises:
        BadInput: a word names a folder, in which any file might belong to the policy.
    """
    files = {}
    for word in words:
        _, path = _split_path(word)
        if path is not None and path.is_dir():
            raise BadInput(f"{path} is a folder; name the files that the policy consists of, so that they are hashed")
        if path is not None:
            files[str(path)] = hash_file(path)
    return files


def _split(command: str) -> list[str]:
    try:
        return shlex.split(command)
    except ValueError as error:
        raise BadInput(f"the command {command!r} cannot be read as a shell would: {error}") from error


def _find_program(python: str) -> str:
    program = shutil.which(user_path(python))
    if program is None:
        raise BadInput(f"there is no program {python!r}; give --python /path/to/bin/python, which has d3rlpy")
    return str(Path(program).absolute())


# ------------------------------------------------------------------------------------------------------------- act


class ForeignPolicy:
    """A policy that another program trained; it uses no return, and its actions are checked."""

    agent = FOREIGN
    uses_return = False

    def __init__(self, act: Act, meta: dict[str, Any]):
        self.meta = meta
        self._act = act
        self._n_clipped = np.zeros(0, dtype=np.int64)

    def begin(self, n_episodes: int, target_return: float | None = None) -> None:
        """Start N episodes; the target return is not used.

        Raises:
            ZestError: the policy fails.
        """
        self._n_clipped = np.zeros(n_episodes, dtype=np.int64)
        with self._naming_the_policy("begin"):
            _call(self._act, "begin", n_episodes)

    def act(self, obs: FloatArray) -> FloatArray:
        """Return actions (N, act_dim) float32 for obs (N, obs_dim) float32, clipped to [-1, 1]; `end` counts those.

        Raises:
            ZestError: the policy fails, or its actions have another shape or are not finite.
        """
        check_obs(obs, len(self._n_clipped), self.meta["obs_dim"])
        with self._naming_the_policy(f"obs of shape {obs.shape}"):
            actions: FloatArray = np.asarray(self._act(obs), dtype=np.float32)
        expected = (len(obs), self.meta["act_dim"])
        if actions.shape != expected:
            raise ZestError(
                f"{self._name} must give actions of shape {expected} for obs {obs.shape}, got {actions.shape}"
            )
        bad = np.flatnonzero(~np.isfinite(actions).all(axis=1))
        if len(bad):
            raise ZestError(
                f"{self._name} gave NaN or infinity as action of {len(bad)} of {len(actions)} episodes (the first is "
                f"{bad[0]}); its weights are broken, or it was trained on observations of another scale"
            )
        self._n_clipped += (np.abs(actions) > 1 + TOLERANCE).any(axis=1)
        clipped: FloatArray = actions.clip(-1, 1)
        return clipped

    def observe(self, rewards: FloatArray) -> None:
        """Ignore the rewards."""

    def end(self) -> dict[str, NDArray[Any]]:
        """End the policy's process, if it has one; return ``clipped`` (N,), the number of actions beyond [-1, 1]."""
        with self._naming_the_policy("end"):
            _call(self._act, "end")
        return {"clipped": self._n_clipped}

    @property
    def _name(self) -> str:
        return f"policy {self.meta['name']!r} ({self.meta['policy']['family']})"

    @contextmanager
    def _naming_the_policy(self, call: str) -> Iterator[None]:
        """Turn any error of the other program into a `ZestError` that names the policy."""
        try:
            yield
        except ZestError as error:
            raise ZestError(f"{self._name}: {error}") from error
        except Exception as error:
            last = (str(error).strip().splitlines() or [""])[-1]
            raise ZestError(f"{self._name} failed on {call} ({type(error).__name__}: {last})") from error


def _call(policy: Act, method: str, *arguments: Any) -> None:
    """Call a method if the policy has it."""
    bound = getattr(policy, method, None)
    if callable(bound):
        bound(*arguments)


def load(run_dir: Path, meta: dict[str, Any], device: torch.device) -> ForeignPolicy:
    """Return the policy of a run that `zest_rl.training.adoption.adopt` made.

    Raises:
        BadInput: its description is damaged, it is not trusted, a file cannot be read, or its family is not known here.
        ZestError: a file is missing or was changed, or the library that reads it is not installed.
    """
    with reading_record(run_dir / "meta.json"):
        identity, name = PolicyIdentity.from_json(meta["policy"]), str(meta["name"])
        obs_dim, act_dim = operator.index(meta["obs_dim"]), operator.index(meta["act_dim"])
    check_trusted("policy", meta["policy"], f"{run_dir} holds the policy {name!r}, which {identity.what_runs()}")
    for file, sha256 in identity.files.items():
        path = run_dir / file
        if not path.is_file() or hash_file(path) != sha256:
            raise ZestError(
                f"{path} is missing or was changed since `zest adopt` saw it, which makes it another policy; restore "
                "it, or adopt the new one"
            )
    paths = {file: str(run_dir / file) for file in identity.files}  # absolute paths stay as they are
    words = [paths.get(word, word) for word in identity.words]
    if identity.family == "torchscript":
        return ForeignPolicy(_read_torchscript(Path(words[0]), device), meta)
    if identity.family == "onnx":
        return ForeignPolicy(_read_onnx(Path(words[0])), meta)
    if identity.family in FAMILIES:
        if identity.family == "d3rlpy":
            words.insert(1, str(Path(__file__).with_name("serve_d3rlpy.py")))
        return ForeignPolicy(PolicyProcess(words, obs_dim, act_dim), meta)
    return ForeignPolicy(_build_registered(identity), meta)


def _read_torchscript(path: Path, device: torch.device) -> Act:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # torch recommends another format
            module = torch.jit.load(str(path), map_location=device).eval()  # type: ignore[no-untyped-call]
    except (RuntimeError, ValueError) as error:
        raise BadInput(
            f"{path.name} cannot be read as TorchScript; write it with torch.jit.save or d3rlpy's save_policy "
            "(weights of torch.save are no policy: they do not say what is computed)"
        ) from error
    return _TorchScript(module, device)


class _TorchScript:
    def __init__(self, module: Any, device: torch.device):
        self._module, self._device = module, device
        dtypes = {weight.dtype for weight in module.state_dict().values() if weight.is_floating_point()}
        self._dtype = dtypes.pop() if len(dtypes) == 1 else torch.float32
        if hasattr(module, "begin"):
            self.begin = module.begin

    @torch.no_grad()
    def __call__(self, obs: FloatArray) -> NDArray[Any]:
        output = self._module(torch.from_numpy(obs).to(self._device, self._dtype))
        actions = output[0] if isinstance(output, tuple | list) else output  # then values or log-probabilities follow
        if not isinstance(actions, torch.Tensor):
            raise ZestError(
                f"its output must be a tensor of actions or begin with one, got {type(output).__name__}; wrap it in a "
                "module that returns the actions alone"
            )
        return actions.float().cpu().numpy()


def _read_onnx(path: Path) -> Act:
    try:
        import onnxruntime
    except ImportError as error:
        raise ZestError("ONNX policies need onnxruntime, which is not installed: pip install onnxruntime") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its exceptions have no common class
        raise BadInput(
            f"{path.name} cannot be read as ONNX ({str(error).strip().splitlines()[-1]}); weights outside of the file "
            f"are looked for in {path.name}.data alone"
        ) from error
    inputs = session.get_inputs()
    if len(inputs) != 1:
        raise BadInput(
            f"an ONNX policy must have one input, the observations, got {', '.join(node.name for node in inputs)}; "
            "serve others by command:"
        )
    dtypes = {"tensor(float)": np.float32, "tensor(double)": np.float64, "tensor(float16)": np.float16}
    if inputs[0].type not in dtypes:
        raise BadInput(f"the input of an ONNX policy must be {', '.join(dtypes)}, got {inputs[0].type}")
    run = partial(_run_onnx, session, inputs[0].name, dtypes[inputs[0].type])
    return run if inputs[0].shape[:1] != [1] else lambda obs: np.concatenate([run(row[None]) for row in obs])


def _run_onnx(session: Any, name: str, dtype: Any, obs: FloatArray) -> NDArray[Any]:
    actions: NDArray[Any] = session.run(None, {name: obs.astype(dtype)})[0]  # then values or log-probabilities follow
    return actions


def _build_registered(identity: PolicyIdentity) -> Act:
    """Call the registered function of another package with the rest of the spec."""
    entry = _registered().get(identity.family)
    if entry is None:
        raise BadInput(
            f"no installed package registers policies {identity.family}:, as {identity.code} did when this one was "
            "adopted; install it again"
        )
    registered = f"{entry.value}, which is registered for {entry.name}:,"
    try:
        act = entry.load()(identity.words[0])
    except Exception as error:
        raise ZestError(f"{registered} failed on {identity.words[0]!r} ({type(error).__name__}: {error})") from error
    if not callable(act):
        raise ZestError(f"{registered} must return a callable from obs to actions, got {type(act).__name__}")
    built: Act = act
    return built
