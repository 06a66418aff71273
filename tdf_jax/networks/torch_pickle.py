"""The pickle inside a PyTorch checkpoint, interpreted without being executed.

`torch.save` writes a zip of raw storages and a pickle that describes how they form tensors. Python's unpickler would
import and call whatever the pickle names. This interpreter knows only the instructions that a state_dict needs. It
treats the few names that such a pickle may contain as strings, never imports them, and refuses all other names.
"""

import dataclasses
import math
import pickletools
from typing import Any, TypeVar, cast

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
CONSTRUCTORS = {"collections.OrderedDict", "torch._utils._rebuild_tensor_v2", "torch._utils._rebuild_parameter"}
STORAGE_LIMIT = 2**30  # bytes; the largest of the published network has 0.5 MB
DIMENSION_LIMIT = 8  # bounds the product of a hostile file's shape; tensors of the network have two dimensions


T = TypeVar("T")


class Refusal(Exception):
    """Reason why a file is not converted; `convert_checkpoint` adds the file."""


@dataclasses.dataclass(frozen=True)
class _Global:
    """A name in the pickle: a string that is never looked up."""

    name: str


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


def interpret(pickled: bytes) -> object:
    """Content of a state_dict's pickle: dictionaries, lists, tuples, numbers, strings and `Tensor`s."""
    try:
        return _run(pickled)
    except (ValueError, IndexError, KeyError) as error:  # a malformed instruction, an empty stack, an unknown memo
        raise Refusal(f"its pickle is damaged ({type(error).__name__}: {error}); copy the file again") from None


def _run(pickled: bytes) -> object:
    stack, marks, memo = [], [], {}

    def pop_to_mark() -> list:
        start = marks.pop()
        items = stack[start:]
        del stack[start:]
        return items

    for opcode, argument, _ in pickletools.genops(pickled):
        match opcode.name:
            case "PROTO" | "FRAME":
                pass
            case "STOP":
                return stack.pop()
            case "MARK":
                marks.append(len(stack))
            case "BINUNICODE" | "SHORT_BINUNICODE" | "BININT" | "BININT1" | "BININT2" | "LONG1" | "BINFLOAT":
                stack.append(argument)
            case "NONE" | "NEWTRUE" | "NEWFALSE":
                stack.append({"NONE": None, "NEWTRUE": True, "NEWFALSE": False}[opcode.name])
            case "EMPTY_DICT":
                stack.append({})
            case "EMPTY_LIST":
                stack.append([])
            case "EMPTY_TUPLE":
                stack.append(())
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                items = [stack.pop() for _ in range(int(opcode.name[-1]))]
                stack.append(tuple(reversed(items)))
            case "TUPLE":
                stack.append(tuple(pop_to_mark()))
            case "APPEND":
                item = stack.pop()
                _expect(stack[-1], list).append(item)
            case "APPENDS":
                items = pop_to_mark()
                _expect(stack[-1], list).extend(items)
            case "SETITEM":
                value, key = stack.pop(), stack.pop()
                _set_items(stack[-1], [key, value])
            case "SETITEMS":
                items = pop_to_mark()
                _set_items(stack[-1], items)
            case "BINPUT" | "LONG_BINPUT":
                memo[argument] = stack[-1]
            case "MEMOIZE":
                memo[len(memo)] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                stack.append(memo[argument])
            case "GLOBAL":
                stack.append(_global(_expect(argument, str).replace(" ", ".", 1)))
            case "STACK_GLOBAL":
                attribute, module = _expect(stack.pop(), str), _expect(stack.pop(), str)
                stack.append(_global(f"{module}.{attribute}"))
            case "BINPERSID":
                stack.append(_storage(stack.pop()))
            case "REDUCE":
                arguments, function = _expect(stack.pop(), tuple), _expect(stack.pop(), _Global)
                stack.append(_construct(function.name, arguments))
            case "BUILD":
                # Attributes of a dictionary are dropped: PyTorch's `_metadata` are versions of layers, of no use here.
                _expect(stack.pop(), dict)
                _expect(stack[-1], dict)
            case _:
                asked = f"INST {str(argument).replace(' ', '.', 1)}" if opcode.name == "INST" else opcode.name
                raise Refusal(f"its pickle references {asked}, an instruction that no state_dict needs")
    raise ValueError("no STOP")


def _global(name: str) -> _Global:
    if name not in STORAGES and name not in CONSTRUCTORS:
        raise Refusal(
            f"it references {name}, and a checkpoint may only reference tensors. If you trust the file, load it in "
            "PyTorch and save model.state_dict() alone"
        )
    return _Global(name)


def _expect(value: object, kind: type[T]) -> T:
    if type(value) is not kind:
        raise ValueError(f"{type(value).__name__} where {kind.__name__} is expected")
    return cast(T, value)


def _set_items(target: object, items: list) -> None:
    """Put items, which are keys and values in turn, into a dictionary."""
    dictionary = _expect(target, dict)
    for key, value in zip(items[::2], items[1::2], strict=True):
        # Keys are flat because hashing a tuple that is nested in itself many times would not end.
        if type(key) not in (str, int):
            raise ValueError(f"{type(key).__name__} as a key")
        dictionary[key] = value


def _construct(name: str, arguments: tuple) -> object:
    match name, arguments:
        case "collections.OrderedDict", ():
            return {}
        case "torch._utils._rebuild_parameter", (Tensor() as tensor, *_):
            return tensor
        case "torch._utils._rebuild_tensor_v2", (Storage() as storage, offset, tuple(shape), tuple(strides), *_):
            return _tensor(storage, offset, shape, strides)
    raise ValueError(f"{name} with arguments that PyTorch does not give it")


def _storage(identifier: object) -> Storage:
    match identifier:
        case ("storage", _Global(name), str(key), str(), int(count)) if name in STORAGES and count >= 0:
            storage = Storage(key, STORAGES[name], count)
        case _:
            raise ValueError("a storage that is not described as PyTorch does")
    if count * jnp.dtype(storage.dtype).itemsize > STORAGE_LIMIT:
        raise Refusal(f"it claims a storage of {count} {storage.dtype} numbers; at most {STORAGE_LIMIT} bytes are read")
    return storage


def _tensor(storage: Storage, offset: Any, shape: tuple, strides: tuple) -> Tensor:
    numbers = (offset, *shape, *strides)
    counts = all(type(number) is int and number >= 0 for number in numbers)
    if not counts or len(shape) != len(strides) or len(shape) > DIMENSION_LIMIT:
        raise ValueError("a tensor whose offset, shape or strides are not counts")
    # A tensor is no larger than its storage: a stride of 0 could otherwise ask for any amount of memory.
    last = offset + sum((size - 1) * stride for size, stride in zip(shape, strides, strict=True))
    if not 0 < math.prod(shape) <= storage.count or last >= storage.count:
        raise Refusal(
            f"a tensor of shape {shape}, strides {strides} and offset {offset} does not lie in its storage of"
            f" {storage.count} numbers; copy the file again"
        )
    return Tensor(storage, offset, shape, strides)
