"""Tensors out of torch's zip archives (``torch.save``, TorchScript) without running anything that they hold.

Both are a pickle, ``data.pkl``, beside one uncompressed file per storage. Of the pickle, tensors and plain values are
built; an object of any other class (the options of a training script, a whole model, a TorchScript module) becomes an
`Inert` bag of its attributes, whose code is neither looked up nor called.
"""

from __future__ import annotations

import io
import pickle
import re
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import torch

MAX_PICKLE = 2**24
"""Bytes of a pickle, which holds names and shapes; the largest models need a tenth."""
MAX_CODE = 2**26
"""Bytes by which the entries of an archive may exceed it: the code of TorchScript is compressed, weights are not."""
MAX_MODULES = 100_000
"""Modules of a TorchScript archive, those that are met again counted again."""
_STORAGES = {
    "DoubleStorage": torch.float64, "FloatStorage": torch.float32, "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16, "LongStorage": torch.int64, "IntStorage": torch.int32,
    "ShortStorage": torch.int16, "CharStorage": torch.int8, "ByteStorage": torch.uint8, "BoolStorage": torch.bool,
}  # fmt: skip
_LIST_TAGS = ("restore_type_tag", "build_intlist", "build_doublelist", "build_boollist", "build_tensorlist")

_SLOTS = re.compile(r"^class (\w+)\(Module\):\n  __parameters__ = \[(.*)\]\n  __buffers__ = \[(.*)\]$", re.MULTILINE)


class Inert:
    """What stands for an object of a class that is not built; subclasses are named after it."""

    state: Any = None
    """Its attributes, as the pickle gave them."""

    def __init__(self, *_: object) -> None:
        """Ignore the arguments."""


def read_archive(path: Path) -> Any:
    """Return what ``torch.save`` wrote, or the state dict of a TorchScript module.

    Raises:
        ValueError: the archive is not as torch writes it. What else goes wrong in a damaged one raises whatever it
            does: read in `zest_rl.embedders.checkpoints.reading`.
    """
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        if sum(entry.file_size for entry in entries) > path.stat().st_size + MAX_CODE:
            raise ValueError("its entries are together larger than the file")
        roots = [entry.filename.removesuffix("data.pkl") for entry in entries if entry.filename.endswith("/data.pkl")]
        if len(roots) != 1:
            raise ValueError(f"expected one data.pkl, got {len(roots)}")
        root, names = roots[0], archive.namelist()
        if archive.getinfo(f"{root}data.pkl").file_size > MAX_PICKLE:
            raise ValueError(f"its data.pkl is larger than {MAX_PICKLE} bytes")
        if f"{root}byteorder" in names and archive.read(f"{root}byteorder") != b"little":
            raise ValueError("it was written on a big-endian machine")
        value = _Unpickler(
            io.BytesIO(archive.read(f"{root}data.pkl")), lambda key: archive.read(f"{root}data/{key}")
        ).load()
        if f"{root}constants.pkl" not in names:
            return value
        code = f"{root}code/"
        slots = {
            f"{name.removeprefix(code).removesuffix('.py').replace('/', '.')}.{declared[1]}": re.findall(
                r'"(.*?)"', f"{declared[2]}{declared[3]}"
            )
            for name in names
            if name.startswith(code) and name.endswith(".py")
            for declared in _SLOTS.finditer(archive.read(name).decode())
        }
    state = {}
    for count, (prefix, tensors) in enumerate(_modules(value, slots, "")):
        if count > MAX_MODULES:
            raise ValueError(f"it has more than {MAX_MODULES} modules")
        state.update({f"{prefix}{name}": tensor for name, tensor in tensors.items()})
    return state


def _modules(value: Any, slots: dict[str, list[str]], prefix: str) -> Iterator[tuple[str, dict[str, torch.Tensor]]]:
    """Yield prefix and tensors of a module and those in it, in the order of ``state_dict``."""
    state = value.state if isinstance(value.state, dict) else {}
    names = slots.get(type(value).__name__, ())
    yield prefix, {name: state[name] for name in names if isinstance(state.get(name), torch.Tensor)}
    for name, part in state.items():
        if isinstance(part, Inert):
            yield from _modules(part, slots, f"{prefix}{name}.")


class _Unpickler(pickle._Unpickler):
    """Builds tensors, containers and plain values. In Python, as C's makes room for whatever length a pickle names."""

    stack: list[Any]
    append: Callable[[Any], None]
    pop_mark: Callable[[], list[Any]]
    dispatch: ClassVar[dict[int, Callable[[Any], None]]] = {
        op: load for op, load in pickle._Unpickler.dispatch.items() if op != pickle.BYTEARRAY8[0]
    }

    def __init__(self, file: io.BytesIO, read: Callable[[str], bytes]) -> None:
        super().__init__(file)
        self._read, self._storages = read, dict[str, torch.Tensor]()

    def find_class(self, module: str, name: str) -> Any:
        """Return what builds objects of a class: never the class."""
        if (module, name) == ("collections", "OrderedDict"):
            return lambda *_: {}  # its items follow
        if (module, name) == ("torch.storage", "UntypedStorage"):
            return torch.uint8
        if module == "torch" and isinstance(vars(torch).get(name), torch.dtype):
            return vars(torch)[name]
        if module == "torch" and name in _STORAGES:
            return _STORAGES[name]
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return lambda storage, offset, size, stride, *_: storage.as_strided(size, stride, offset)
        if (module, name) == ("torch._utils", "_rebuild_tensor_v3"):  # of newer dtypes, such as float8
            return lambda storage, offset, size, stride, _, __, dtype, *___: storage.view(dtype).as_strided(
                size, stride, offset
            )
        is_wrapper = (module, name) == ("torch._utils", "_rebuild_parameter")
        if is_wrapper or (module == "torch.jit._pickle" and name in _LIST_TAGS):
            return lambda value, *_: value
        return type(f"{module}.{name}", (Inert,), {})

    def persistent_load(self, pid: Any) -> torch.Tensor:
        """Return a storage as one flat tensor."""
        _, dtype, key, _, n = pid
        if not isinstance(key, str):
            raise ValueError(f"a storage is named by a {type(key).__name__}")
        if key not in self._storages:
            data = bytearray(self._read(key))
            self._storages[key] = torch.frombuffer(data, dtype=dtype, count=n) if n else torch.empty(0, dtype=dtype)
        return self._storages[key]

    def load_build(self) -> None:
        """Keep the attributes of an inert object; those of a dictionary are torch's notes of versions."""
        state = self.stack.pop()
        if isinstance(self.stack[-1], Inert):
            self.stack[-1].state = state

    def load_dict(self) -> None:
        """Push a dictionary of the items since the mark."""
        items = self.pop_mark()
        self.append({})
        self._put(items)

    def load_setitem(self) -> None:
        """Put one item into the dictionary below it."""
        value, key = self.stack.pop(), self.stack.pop()
        self._put([key, value])

    def load_setitems(self) -> None:
        """Put the items since the mark into the dictionary below it."""
        self._put(self.pop_mark())

    def _put(self, items: list[Any]) -> None:
        """Keep what has a plain key: nested tuples, which name no weights, can take forever to hash."""
        if isinstance(self.stack[-1], dict):
            pairs = zip(items[::2], items[1::2], strict=True)
            self.stack[-1].update((key, value) for key, value in pairs if isinstance(key, str | int))

    def load_additems(self) -> None:
        """Leave sets empty: they hold no weights, and hash what they hold."""
        self.pop_mark()

    def load_frozenset(self) -> None:
        """Push an empty set; see `load_additems`."""
        self.pop_mark()
        self.append(frozenset())

    dispatch |= {
        pickle.BUILD[0]: load_build, pickle.DICT[0]: load_dict, pickle.SETITEM[0]: load_setitem,
        pickle.SETITEMS[0]: load_setitems, pickle.ADDITEMS[0]: load_additems, pickle.FROZENSET[0]: load_frozenset,
    }  # fmt: skip
