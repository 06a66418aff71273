"""The pickle inside a PyTorch checkpoint, interpreted without being executed.

`torch.save` writes a zip of raw storages and a pickle that describes how they form tensors. Python's unpickler would
import and call whatever the pickle names. This interpreter knows dictionaries, lists, numbers, strings and tensors.
Every name in the pickle is a string that is never imported. What an unknown name would build, such as the
hyperparameters of a training framework, becomes an `Unknown`, which is no more than a dictionary.
"""

import dataclasses
import math
import pickletools
from typing import Any, NamedTuple, TypeVar, cast

import jax.numpy as jnp

STORAGES = {
    "torch.FloatStorage": "float32",
    "torch.DoubleStorage": "float64",
    "torch.HalfStorage": "float16",
    "torch.BFloat16Storage": "bfloat16",
    "torch.LongStorage": "int64",
    "torch.IntStorage": "int32",
    "torch.ShortStorage": "int16",
    "torch.CharStorage": "int8",
    "torch.ByteStorage": "uint8",
    "torch.BoolStorage": "bool",
}
DICTIONARY = "collections.OrderedDict"
TENSORS = {"torch._utils._rebuild_tensor", "torch._utils._rebuild_tensor_v2"}
# Wrappers of a tensor, which is their first argument.
PARAMETERS = {"torch._utils._rebuild_parameter", "torch._utils._rebuild_parameter_with_state"}
SUBCLASS = "torch._tensor._rebuild_from_type_v2"  # its arguments are a function, a class, and the function's arguments
KNOWN = {*STORAGES, *TENSORS, *PARAMETERS, DICTIONARY, SUBCLASS}
STORAGE_LIMIT = 2**30  # bytes; the largest of the published network has 0.5 MB
LONGEST_KEY = 200  # characters; of a module's parameter they are about 50
DIMENSION_LIMIT = 8  # bounds the product of a hostile file's shape; tensors of the network have two dimensions
CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
# Instructions whose argument is a value.
VALUES = {
    "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "UNICODE", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8",
    "BINSTRING", "SHORT_BINSTRING", "STRING", "BININT", "BININT1", "BININT2", "INT", "LONG", "LONG1", "LONG4",
    "BINFLOAT", "FLOAT",
}  # fmt: skip

T = TypeVar("T")


class Refusal(Exception):
    """Reason why a file is not converted; `convert_checkpoint` adds the file."""


@dataclasses.dataclass(frozen=True)
class _Global:
    """A name in the pickle: a string that is never looked up."""

    name: str


class Unknown(dict):
    """What an unknown name would build: its items and attributes, as far as they are in the pickle."""

    def __init__(self, name: str):
        super().__init__()
        self.name = name


@dataclasses.dataclass(frozen=True)
class Storage:
    """A block of numbers: key of its zip member, type and number of elements."""

    key: str
    dtype: str
    count: int


@dataclasses.dataclass(frozen=True)
class Tensor:
    """A view of a storage; offset and strides count elements."""

    storage: Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


@dataclasses.dataclass(frozen=True)
class Unusable:
    """A storage or a tensor that cannot be read, which matters only if it belongs to the network."""

    reason: str


class Content(NamedTuple):
    """A pickle's content: dictionaries, lists, tuples, numbers, strings, `Tensor`s; and the unknown names in it."""

    tree: object
    unknown: tuple[str, ...]


def interpret(pickled: bytes) -> Content:
    """Content of a checkpoint's pickle.

    Args:
        pickled: the pickle.

    Raises:
        Refusal: it is damaged, or has an instruction that no checkpoint needs.
    """
    machine = _Machine()
    try:
        return Content(machine.run(pickled), tuple(machine.unknown))
    except (ValueError, IndexError, KeyError) as error:  # a malformed instruction, an empty stack, an unknown memo
        raise Refusal(f"its pickle is damaged ({type(error).__name__}: {error}); copy the file again") from None


class _Machine:
    """State of the interpreter: the stack, the memo, and the unknown names in their order."""

    def __init__(self):
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[Any, Any] = {}
        self.unknown: dict[str, None] = {}

    def run(self, pickled: bytes) -> object:
        stack, marks, memo = self.stack, self.marks, self.memo
        for opcode, argument, _ in pickletools.genops(pickled):
            match opcode.name:
                case "PROTO" | "FRAME":
                    pass
                case "STOP":
                    return stack.pop()
                case "MARK":
                    marks.append(len(stack))
                case name if name in VALUES:
                    stack.append(argument)
                case name if name in CONSTANTS:
                    stack.append(CONSTANTS[name])
                case "EMPTY_DICT":
                    stack.append({})
                case "EMPTY_LIST" | "EMPTY_SET":  # sets are lists, because nothing in them is hashed
                    stack.append([])
                case "EMPTY_TUPLE":
                    stack.append(())
                case "TUPLE1" | "TUPLE2" | "TUPLE3":
                    items = [stack.pop() for _ in range(int(opcode.name[-1]))]
                    stack.append(tuple(reversed(items)))
                case "TUPLE" | "FROZENSET":
                    stack.append(tuple(self.pop_to_mark()))
                case "LIST":
                    stack.append(self.pop_to_mark())
                case "DICT":
                    items = self.pop_to_mark()
                    stack.append({})
                    _set_items(stack[-1], items)
                case "APPEND":
                    item = stack.pop()
                    _extend(stack[-1], [item])
                case "APPENDS" | "ADDITEMS":
                    items = self.pop_to_mark()
                    _extend(stack[-1], items)
                case "SETITEM":
                    value, key = stack.pop(), stack.pop()
                    _set_items(stack[-1], [key, value])
                case "SETITEMS":
                    items = self.pop_to_mark()
                    _set_items(stack[-1], items)
                case "POP":
                    if marks and marks[-1] == len(stack):
                        marks.pop()
                    else:
                        stack.pop()
                case "POP_MARK":
                    self.pop_to_mark()
                case "DUP":
                    stack.append(stack[-1])
                case "BINPUT" | "LONG_BINPUT" | "PUT":
                    memo[argument] = stack[-1]
                case "MEMOIZE":
                    memo[len(memo)] = stack[-1]
                case "BINGET" | "LONG_BINGET" | "GET":
                    stack.append(memo[argument])
                case "GLOBAL":
                    stack.append(self.named(_expect(argument, str).replace(" ", ".", 1)))
                case "STACK_GLOBAL":
                    attribute, module = _expect(stack.pop(), str), _expect(stack.pop(), str)
                    stack.append(self.named(f"{module}.{attribute}"))
                case "BINPERSID":
                    stack.append(_storage(stack.pop()))
                case "REDUCE" | "NEWOBJ":
                    arguments, function = _expect(stack.pop(), tuple), stack.pop()
                    stack.append(_construct(function, arguments))
                case "NEWOBJ_EX":
                    _, arguments, function = stack.pop(), _expect(stack.pop(), tuple), stack.pop()
                    stack.append(_construct(function, arguments))
                case "OBJ":
                    function, *arguments = self.pop_to_mark()
                    stack.append(_construct(function, tuple(arguments)))
                case "INST":
                    arguments = tuple(self.pop_to_mark())
                    stack.append(_construct(self.named(_expect(argument, str).replace(" ", ".", 1)), arguments))
                case "BUILD":
                    state = stack.pop()
                    _set_state(stack[-1], state)
                case _:
                    raise Refusal(f"its pickle references {opcode.name}, an instruction that no checkpoint needs")
        raise ValueError("no STOP")

    def pop_to_mark(self) -> list:
        start = self.marks.pop()
        items = self.stack[start:]
        del self.stack[start:]
        return items

    def named(self, name: str) -> _Global:
        if name not in KNOWN:
            self.unknown[name] = None
        return _Global(name)


def _expect(value: object, kind: type[T]) -> T:
    if type(value) is not kind:
        raise ValueError(f"{type(value).__name__} where {kind.__name__} is expected")
    return cast(T, value)


def _extend(target: object, items: list) -> None:
    if not isinstance(target, Unknown):  # the items of an unknown list are dropped
        _expect(target, list).extend(items)


def _set_items(target: object, items: list) -> None:
    """Put items, which are keys and values in turn, into a dictionary."""
    dictionary = target if isinstance(target, Unknown) else _expect(target, dict)
    for key, value in zip(items[::2], items[1::2], strict=True):
        # Other keys do not lead to a tensor of a network, and are dropped: hashing a tuple that is nested in itself
        # many times would not end, and names made of long keys would fill the memory.
        if (type(key) is str and len(key) <= LONGEST_KEY) or (type(key) is int and abs(key) < 2**63):
            dictionary[key] = value


def _set_state(target: object, state: object) -> None:
    """Give an object its attributes."""
    if not isinstance(target, Unknown):
        # Attributes of a dictionary are dropped: PyTorch's `_metadata` are versions of layers, of no use here.
        _expect(target, dict)
        _expect(state, dict)
        return
    for part in state if isinstance(state, tuple) else (state,):  # attributes, and those in slots
        if isinstance(part, dict):
            target.update(part)


def _construct(function: object, arguments: tuple) -> object:
    """What a call of a name gives."""
    if isinstance(function, Unknown):
        return Unknown(function.name)
    name = _expect(function, _Global).name
    match name, arguments:
        case _, _ if name == DICTIONARY and not arguments:
            return {}
        case _, ((Tensor() | Unusable()) as tensor, *_) if name in PARAMETERS:
            return tensor
        case _, (Unusable() as storage, *_) if name in TENSORS:
            return storage
        case _, (Storage() as storage, offset, tuple(shape), tuple(strides), *_) if name in TENSORS:
            return _tensor(storage, offset, shape, strides)
        case _, (_Global() as inner, _, tuple() as inner_arguments, *_) if name == SUBCLASS and inner.name != SUBCLASS:
            return _construct(inner, inner_arguments)
        case _ if name not in KNOWN:
            return Unknown(name)
    raise ValueError(f"{name} with arguments that PyTorch does not give it")


def _storage(identifier: object) -> Storage | Unusable:
    match identifier:
        case ("storage", _Global(name), str(key), str(), int(count), *_) if count >= 0:
            if name not in STORAGES:
                return Unusable(f"holds numbers of the kind {name}; expected floating point")
            storage = Storage(key, STORAGES[name], count)
        case _:
            raise ValueError("a storage that is not described as PyTorch does")
    if count * jnp.dtype(storage.dtype).itemsize > STORAGE_LIMIT:
        return Unusable(
            f"claims a storage of {count} {storage.dtype} numbers; expected at most {STORAGE_LIMIT} bytes; save a clone"
        )
    return storage


def _tensor(storage: Storage, offset: Any, shape: tuple, strides: tuple) -> Tensor | Unusable:
    numbers = (offset, *shape, *strides)
    counts = all(type(number) is int and number >= 0 for number in numbers)
    if not counts or len(shape) != len(strides) or len(shape) > DIMENSION_LIMIT:
        raise ValueError("a tensor whose offset, shape or strides are not counts")
    # A tensor is no larger than its storage: a stride of 0 could otherwise ask for any amount of memory.
    last = offset + sum((size - 1) * stride for size, stride in zip(shape, strides, strict=True))
    if not 0 < math.prod(shape) <= storage.count or last >= storage.count:
        return Unusable(
            f"of shape {shape}, strides {strides} and offset {offset} does not lie in its storage of {storage.count} "
            "numbers; copy the file again"
        )
    return Tensor(storage, offset, shape, strides)
