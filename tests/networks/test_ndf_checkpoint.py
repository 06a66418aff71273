"""Checkpoint files are put together here by hand, instruction by instruction: torch would not write most of them."""

import gzip
import io
import math
import os
import pickle
import re
import struct
import sys
import tarfile
import zipfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
from flax.traverse_util import flatten_dict

from tdf_jax._internal.errors import InputError
from tdf_jax.cli.convert import convert
from tdf_jax.networks import tensor_file
from tdf_jax.networks.checkpoint import load_model, save_model
from tdf_jax.networks.ndf_checkpoint import convert_checkpoint
from tdf_jax.networks.occupancy import NetworkConfig, parameter_shapes
from tdf_jax.networks.torch_pickle import Refusal, interpret

FIXTURES = Path(__file__).parents[1] / "fixtures"
CONFIG = NetworkConfig(latent=3, decoder_width=5)  # unequal and small, so that a missed transposition shows


def text(string):
    return b"X" + struct.pack("<I", len(string.encode())) + string.encode()


def integer(number):
    """BININT, or LONG1 where 32 bits do not hold the number."""
    if -(2**31) <= number < 2**31:
        return b"J" + struct.pack("<i", number)
    return b"\x8a\x08" + struct.pack("<q", number)


def sequence(*items):
    return b"(" + b"".join(items) + b"t"


def named(module, name):
    return b"c" + f"{module}\n{name}\n".encode()


def called(function, *arguments):
    return function + sequence(*arguments) + b"R"


def dictionary(items, kind=None):
    start = called(named("collections", "OrderedDict")) if kind is None else kind
    return start + b"(" + b"".join(text(key) + value for key, value in items.items()) + b"u"


def storage(key, count, kind="FloatStorage", location="cpu"):
    return sequence(text("storage"), named("torch", kind), text(key), text(location), integer(count)) + b"Q"


def tensor(stored, shape, strides=None, offset=0):
    if strides is None:
        strides = [math.prod(shape[axis + 1 :]) for axis in range(len(shape))]
    sizes, steps = sequence(*map(integer, shape)), sequence(*map(integer, strides))
    hooks = called(named("collections", "OrderedDict"))
    return called(named("torch._utils", "_rebuild_tensor_v2"), stored, integer(offset), sizes, steps, b"\x89", hooks)


def pickled(body):
    return b"\x80\x02" + body + b"."


def write_zip(path, pickle_bytes, storages=(), records=None, compression=zipfile.ZIP_STORED, root="archive"):
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr(f"{root}/data.pkl", pickle_bytes)
        for name, content in {"version": b"3\n", **(records or {})}.items():
            archive.writestr(f"{root}/{name}", content)
        for key, raw in dict(storages).items():
            archive.writestr(f"{root}/data/{key}", raw)
    return path


@pytest.fixture(scope="module")
def weights():
    """A state_dict of CONFIG: PyTorch's names, (out, in)."""
    rng = np.random.default_rng(0)
    return {
        name.replace(".kernel", ".weight"): rng.normal(size=shape[::-1]).astype(np.float32)
        for name, shape in parameter_shapes(CONFIG).items()
    }


def raw_bytes(array):
    return array.tobytes()


def write_checkpoint(path, weights, encode=raw_bytes, kind="FloatStorage", location="cpu", prefix="", **options):
    """A checkpoint of one storage per tensor, numbered in order."""
    parts, storages = {}, {}
    for key, (name, array) in enumerate(weights.items()):
        parts[prefix + name] = tensor(storage(str(key), array.size, kind, location), array.shape)
        storages[str(key)] = encode(array)
    wrap = options.pop("wrap", lambda body: body)
    return write_zip(path, pickled(wrap(dictionary(parts))), storages, **options)


def assert_holds(model, weights, tolerance=0.0):
    flat = flatten_dict(model.params, sep=".")
    assert model.config == CONFIG
    assert {name: leaf.shape for name, leaf in flat.items()} == parameter_shapes(CONFIG)
    for name, array in weights.items():
        leaf = flat[name.replace(".weight", ".kernel")]
        assert leaf.dtype == jnp.float32
        np.testing.assert_allclose(leaf, array.T, rtol=tolerance, atol=0.0)


def refusal(path):
    with pytest.raises(InputError) as caught:
        convert_checkpoint(path)
    message = str(caught.value)
    assert message.startswith("convert_checkpoint(): refused to load") and str(path) in message
    return message


# --- files that convert ---


def test_file_written_by_pytorch():
    model = convert_checkpoint(FIXTURES / "ndf_latent32.pth")
    assert model.config == NetworkConfig(latent=32, decoder_width=32)
    assert (model.info.name, model.info.cloud_points) == ("ndf_latent32", None)
    assert "ndf_latent32.pth" in model.info.source
    flat = flatten_dict(model.params, sep=".")
    with zipfile.ZipFile(FIXTURES / "ndf_latent32.pth") as archive:
        # Names and storages come in the same order in a state_dict, so the file can be read without its pickle.
        names = re.findall(rb"((?:en|de)coder[.\w]+\.(?:weight|bias))", archive.read("ndf_latent32/data.pkl"))
        raw = [np.frombuffer(archive.read(f"ndf_latent32/data/{key}"), "<f4") for key in range(len(names))]
    shapes = parameter_shapes(model.config)
    assert len(names) == len(shapes) == len(flat)
    for name, values in zip(names, raw, strict=True):
        name = name.decode().replace(".weight", ".kernel")
        np.testing.assert_array_equal(flat[name], values.reshape(shapes[name][::-1]).T)


def test_name_argument(tmp_path, weights):
    assert convert_checkpoint(write_checkpoint(tmp_path / "a.pth", weights), name="mug").info.name == "mug"


METADATA = b"}" + text("_metadata") + dictionary({"": b"}" + text("version") + integer(1) + b"s"}) + b"sb"


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"location": "cuda:0"},
        {"wrap": lambda body: body + METADATA},
        {"prefix": "module."},
        {"wrap": lambda body: dictionary({"epoch": integer(7), "loss": b"N", "model_state_dict": body}, kind=b"}")},
        {"records": {"byteorder": b"little"}},
        {"records": {"byteorder": b"big"}, "encode": lambda x: x.astype(">f4").tobytes()},
        {"kind": "DoubleStorage", "encode": lambda x: x.astype("<f8").tobytes()},
        {"root": "multi_category_weights"},
    ],
    ids=["plain", "cuda", "metadata", "module", "wrapped", "little", "big", "double", "root"],
)
def test_variants_of_the_file_hold_the_same_weights(tmp_path, weights, options):
    assert_holds(convert_checkpoint(write_checkpoint(tmp_path / "a.pth", weights, **options)), weights)


@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize(
    ("kind", "dtype", "tolerance"), [("HalfStorage", "float16", 1e-3), ("BFloat16Storage", "bfloat16", 1e-2)]
)
def test_half_precision(tmp_path, weights, kind, dtype, tolerance, order):
    def encode(array):
        words = array.astype(jnp.dtype(dtype)).view(np.uint16)
        return words.astype("<u2" if order == "little" else ">u2").tobytes()

    large = {name: np.sign(array) * (np.abs(array) + 0.01) for name, array in weights.items()}  # no float16 subnormals
    path = write_checkpoint(tmp_path / "a.pth", large, encode, kind, records={"byteorder": order.encode()})
    assert_holds(convert_checkpoint(path), large, tolerance)


def test_parameters_transposed_views_and_one_shared_storage(tmp_path, weights):
    """All tensors in one storage, each at its offset, stored transposed and wrapped as a Parameter."""
    total = sum(array.size for array in weights.values())
    parts, pieces, offset = {}, [], 0
    for name, array in weights.items():
        strides = (1, array.shape[0]) if array.ndim == 2 else (1,)
        view = tensor(storage("0", total, location="cuda:0"), array.shape, strides, offset)
        hooks = called(named("collections", "OrderedDict"))
        parts[name] = called(named("torch._utils", "_rebuild_parameter"), view, b"\x88", hooks)
        pieces.append(array.T.tobytes())
        offset += array.size
    path = write_zip(tmp_path / "a.pth", pickled(dictionary(parts)), {"0": b"".join(pieces)})
    assert_holds(convert_checkpoint(path), weights)


def test_command_writes_a_file_that_loads(tmp_path, capsys):
    target = tmp_path / "converted.safetensors"
    convert(str(FIXTURES / "ndf_latent32.pth"), str(target))
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[-1] for line in lines] == ["886,945", "32", str(target)]
    loaded, converted = load_model(target), convert_checkpoint(FIXTURES / "ndf_latent32.pth")
    assert (loaded.config, loaded.info) == (converted.config, converted.info)


# --- where the network is in the file ---


def parts_of(weights, prefix="", first=0):
    """Pickled tensors by name, whose storages are numbered from `first`."""
    numbered = enumerate(weights.items(), first)
    return {prefix + name: tensor(storage(str(key), array.size), array.shape) for key, (name, array) in numbered}


def storages_of(weights, first=0):
    return {str(key): array.tobytes() for key, array in enumerate(weights.values(), first)}


def plain(items):
    """A dictionary of Python, not an OrderedDict."""
    return dictionary(items, kind=b"}")


def instance(module, name, state):
    """An object of a class, with its attributes."""
    return named(module, name) + b")\x81" + plain(state) + b"b"


SCALAR = called(named("numpy._core.multiarray", "scalar"), called(named("numpy", "dtype"), text("f8")), b"C\x02ab")
SPARSE = called(named("torch._utils", "_rebuild_sparse_tensor"), text("x"))
# Tensors that could not be read, but belong to another part.
OTHERS = {
    "loss.weight": tensor(storage("none", 4), (2, 2)),
    "loss.empty": tensor(storage("none", 0), (0,)),
    "second.layers": tensor(storage("none", 2**40), (2**20, 2**20)),
    "second.phase": tensor(storage("none", 2, kind="ComplexFloatStorage"), (2,)),
    "second.edges": SPARSE,
}
HYPERPARAMETERS = {
    "config": instance("omegaconf", "DictConfig", {"_content": plain({"lr": b"G" + struct.pack(">d", 0.1)})}),
    "folder": called(named("pathlib", "PosixPath"), text("/"), text("data")),
    "sizes": b"\x8f(" + integer(1) + integer(2) + b"\x90",
    "best": SCALAR,
    "device": called(named("torch", "device"), text("cuda"), integer(0)),
    "dtype": named("torch", "float32"),
    "many": integer(10**18),
    "table": b"}(" + sequence(integer(1), integer(2)) + integer(3) + b"N" + integer(4) + b"u",
    "queue": called(named("collections", "deque")) + b"(" + integer(1) + integer(2) + b"e",
}


@pytest.mark.parametrize("beside", [{}, OTHERS], ids=["alone", "beside others"])
@pytest.mark.parametrize(
    "prefix", ["module.", "_orig_mod.", "model.", "net.", "module._orig_mod.", "_orig_mod.module.", "a.b.c.d.e."]
)
def test_one_prefix_of_any_kind(tmp_path, weights, prefix, beside):
    path = write_zip(tmp_path / "a.pth", pickled(dictionary(parts_of(weights, prefix) | beside)), storages_of(weights))
    assert_holds(convert_checkpoint(path), weights)


@pytest.mark.parametrize(
    "wrap",
    [
        lambda state: plain({"net": dictionary(state), "epoch": integer(7), "best": SCALAR}),
        lambda state: plain({"optimizer": plain({"state": plain(OTHERS)}), "ema": plain({"model": dictionary(state)})}),
        lambda state: b"](" + dictionary(state) + integer(3) + b"e",
        lambda state: called(named("my.utils", "AttrDict")) + b"(" + text("model") + dictionary(state) + b"u",
        lambda state: plain({"old": b"}" + b"q\x07" + b"(" + b"u", "model": b"h\x07", "x": dictionary(state)}),
    ],
    ids=["key", "nested", "list", "object", "memo"],
)
def test_containers_of_a_state_dict(tmp_path, weights, wrap):
    path = write_zip(tmp_path / "a.pth", pickled(wrap(parts_of(weights))), storages_of(weights))
    assert_holds(convert_checkpoint(path), weights)


def test_checkpoint_of_a_training_framework(tmp_path, weights):
    """The layout of Lightning's, with hyperparameters of unknown classes, which are not imported."""
    content = {
        "epoch": integer(3),
        "pytorch-lightning_version": text("2.2.1"),
        "state_dict": dictionary(parts_of(weights, "model.") | OTHERS),
        "callbacks": plain({"EarlyStopping{}": plain({"best_score": OTHERS["loss.weight"]})}),
        "optimizer_states": b"](" + plain({"state": b"}" + integer(0) + plain(OTHERS) + b"s"}) + b"e",
        "hyper_parameters": instance("lightning.pytorch.utilities.parsing", "AttributeDict", HYPERPARAMETERS),
    }
    before = set(sys.modules)
    path = write_zip(tmp_path / "a.ckpt", pickled(plain(content)), storages_of(weights))
    assert_holds(convert_checkpoint(path), weights)
    assert not {"torch", "omegaconf", "lightning"} & (set(sys.modules) - before)


def test_a_whole_module(tmp_path, weights):
    """As `torch.save(model)` writes it: nested objects with their parameters."""

    def module(state):
        own = {name: value for name, value in state.items() if "." not in name}
        children = {name.split(".")[0] for name in state if "." in name}
        parts = {
            child: module({key.split(".", 1)[1]: value for key, value in state.items() if key.startswith(child + ".")})
            for child in sorted(children)
        }
        return instance(
            "ndf_robot.model",
            "VNNOccNet",
            {"training": b"\x88", "_parameters": plain(own), "_modules": plain(parts), "_buffers": plain({})},
        )

    content = pickled(plain({"model": module(parts_of(weights)), "epoch": integer(1)}))
    assert_holds(convert_checkpoint(write_zip(tmp_path / "a.pth", content, storages_of(weights))), weights)


def test_parameters_of_other_kinds(tmp_path, weights):
    """Parameters with attributes, subclasses of tensors, and a tensor without hooks."""
    constructors = [
        lambda value: called(named("torch._utils", "_rebuild_parameter_with_state"), value, b"\x88", b"}", b"}"),
        lambda value: called(
            named("torch._tensor", "_rebuild_from_type_v2"),
            named("torch._utils", "_rebuild_parameter"),
            named("my", "Tensor"),
            sequence(value, b"\x88", b"}"),
            b"}",
        ),
        lambda value: value.replace(b"_rebuild_tensor_v2", b"_rebuild_tensor"),
    ]
    parts = {name: constructors[index % 3](value) for index, (name, value) in enumerate(parts_of(weights).items())}
    path = write_zip(tmp_path / "a.pth", pickled(dictionary(parts)), storages_of(weights))
    assert_holds(convert_checkpoint(path), weights)


def test_several_networks_are_named_and_chosen_by_prefix(tmp_path, weights, capsys):
    average, count = {name: array + 1 for name, array in weights.items()}, len(weights)
    content = plain({"model": dictionary(parts_of(weights)), "ema": dictionary(parts_of(average, "module.", count))})
    path = write_zip(tmp_path / "a.pth", pickled(content), storages_of(weights) | storages_of(average, count))
    message = refusal(path)
    assert "2 NDF occupancy networks, under the prefixes 'model.', 'ema.module.'" in message
    assert "prefix=, or --prefix" in message
    assert_holds(convert_checkpoint(path, prefix="model"), weights)
    assert_holds(convert_checkpoint(path, prefix="ema.module."), average)
    convert(path, tmp_path / "a.safetensors", prefix="ema.module")
    assert_holds(load_model(tmp_path / "a.safetensors"), average)
    with pytest.raises(InputError, match=r"none .* has the prefix 'ema\.'; expected one of 'model\.', 'ema\.module\.'"):
        convert_checkpoint(path, prefix="ema")


def test_one_network_under_two_names_counts_once(tmp_path, weights):
    content = plain({"model": dictionary(parts_of(weights)), "net": dictionary(parts_of(weights, "module."))})
    assert_holds(convert_checkpoint(write_zip(tmp_path / "a.pth", pickled(content), storages_of(weights))), weights)


def test_tensors_beside_encoder_and_decoder_are_not_ignored(tmp_path, weights):
    """They may be a part of another architecture."""
    for prefix in ("", "model."):
        parts = parts_of(weights, prefix) | {prefix + "head.weight": tensor(storage("0", 4), (2, 2))}
        message = refusal(write_zip(tmp_path / "a.pth", pickled(dictionary(parts)), storages_of(weights)))
        assert "1 not expected: head.weight (2, 2); save the tensors of encoder and decoder alone" in message
        assert not prefix or "under the prefix 'model.'" in message


def test_tensors_of_another_network_are_named_by_their_prefixes(tmp_path):
    content = plain({"state_dict": plain({f"backbone.layer{index}.w": OTHERS["loss.weight"] for index in range(9)})})
    message = refusal(write_zip(tmp_path / "a.pth", pickled(content)))
    assert "none of its 9 tensors" in message and "under 'state_dict.backbone'; save" in message


def test_tensors_of_the_network_that_cannot_be_read_are_named(tmp_path, weights):
    for value, reason in (
        (OTHERS["second.phase"], "holds numbers of the kind torch.ComplexFloatStorage"),
        (OTHERS["loss.empty"], "does not lie in its storage"),
        (SPARSE, "1 missing: decoder.fc_out.bias (1,); it references torch._utils._rebuild_sparse_tensor,"),
    ):
        parts = parts_of(weights, "model.") | {"model.decoder.fc_out.bias": value}
        message = refusal(write_zip(tmp_path / "a.pth", pickled(dictionary(parts)), storages_of(weights)))
        assert reason in message and ("model.decoder.fc_out.bias" in message or value == SPARSE)


def test_hostile_names_do_not_fill_the_memory():
    """Deep and long names, and one dictionary that is held many times, end at once."""
    deep = b"}" + b"".join(text("a") + b"}" for _ in range(50_000)) + b"s" * 50_000
    key = b"X" + struct.pack("<I", 500_000) + b"a" * 500_000
    long = b"}(" + key + b"}(" + b"".join(text(str(i)) + b"}" for i in range(20_000)) + b"uu"
    doubled = b"}q\x00" + b"".join(
        b"}(" + text("a") + b"h" + bytes([i]) + text("b") + b"h" + bytes([i]) + b"uq" + bytes([i + 1])
        for i in range(60)
    )
    dotted = b"}" + text("." * 100_000) + b"N" + b"s"
    number = b"}\x8b" + struct.pack("<i", 5000) + b"\x7f" * 5000 + b"Ns"
    for body in (deep, long, doubled, dotted, number):
        file = tensor_file._tensors(interpret(pickled(body)).tree)
        assert file[0] == {} and len("".join(file[1])) < 1000


# --- safetensors ---


def test_safetensors_with_the_names_of_pytorch(tmp_path, weights):
    path = tmp_path / "a.safetensors"
    safetensors.numpy.save_file({f"model.{name}": array for name, array in weights.items()}, path)
    assert_holds(convert_checkpoint(path), weights)
    for dtype, tolerance in (("float16", 1e-3), (jnp.bfloat16, 1e-2), ("float64", 0.0)):
        large = {name: np.sign(array) * (np.abs(array) + 0.01) for name, array in weights.items()}
        safetensors.numpy.save_file({name: array.astype(dtype) for name, array in large.items()}, path)
        assert_holds(convert_checkpoint(path), large, tolerance)
    safetensors.numpy.save_file({name: array.astype("int8") for name, array in weights.items()}, path)
    assert "holds I8 numbers" in refusal(path)
    content = path.read_bytes()
    path.write_bytes(content[:-1])
    assert "truncated" in refusal(path)


def test_weights_of_tdf_jax_need_no_conversion(tmp_path, small_model):
    save_model(small_model, tmp_path / "a.safetensors")
    assert "holds weights of tdf_jax already" in refusal(tmp_path / "a.safetensors")


# --- files that try to run code ---


class Malicious:
    """Pickles as a call of any function with any arguments."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("function", [os.system, eval, exec, getattr, os.remove], ids=lambda f: f.__name__)
def test_code_is_refused_by_name_and_not_run(tmp_path, function, protocol):
    marker = tmp_path / "marker"
    marker.touch()
    arguments = {
        os.system: (f"rm {marker}",),
        eval: (f"__import__('os').remove({str(marker)!r})",),
        exec: (f"import os; os.remove({str(marker)!r})",),
        getattr: ("", "join"),
        os.remove: (str(marker),),
    }
    attack = Malicious(function, *arguments[function])
    pickle.loads(pickle.dumps(attack, protocol))  # the attack is real
    assert function is getattr or not marker.exists()
    marker.touch()
    contents = [attack] if protocol < 2 else [attack, {"encoder.fc_pos": [1, 2.5], "decoder": (None, attack)}]
    for content in contents:
        message = refusal(write_zip(tmp_path / "a.pth", pickle.dumps(content, protocol)))
        module = "__builtin__" if protocol < 3 and function.__module__ == "builtins" else function.__module__
        assert f"references {module}.{function.__name__}," in message
    assert marker.exists()


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        (called(named("os", "system"), text("true")), "references os.system"),
        (called(named("torch.hub", "load"), text("repository")), "references torch.hub.load"),
        (called(named("torch", "load"), text("file")), "references torch.load"),
        (called(named("ndf_robot.model", "VNNOccNet")), "references ndf_robot.model.VNNOccNet"),
        (b"\x8c\x0bcollections\x8c\x14OrderedDict.fromkeys\x93", "references collections.OrderedDict.fromkeys"),
        (b"(" + text("true") + b"ios\nsystem\n", "references os.system"),
        (named("os", "system") + b")\x81", "references os.system"),
        (b"(" + named("os", "system") + b"o", "references os.system"),
        (called(called(named("builtins", "getattr"), named("os", "system")), text("true")), "getattr, os.system"),
        (b"\x82\x01", "references EXT1"),
        # Allowed things put to other uses: attributes set on a class, a storage called, a string for a function.
        (named("collections", "OrderedDict") + b"}" + text("keys") + integer(1) + b"sb", "damaged"),
        (called(named("collections", "OrderedDict")) + b"N}" + text("a") + integer(1) + b"s\x86b", "damaged"),
        (called(named("torch", "FloatStorage"), integer(3)), "damaged"),
        (called(named("collections", "OrderedDict"), text("abc")), "damaged"),
        (called(text("os.system"), text("true")), "damaged"),
        (called(named("torch._utils", "_rebuild_parameter"), text("abc")), "damaged"),
        (b"}" + sequence(text("a")) + integer(1) + b"s", "expected a state_dict of tensors, got nothing"),
    ],
)
def test_anything_but_tensors_is_refused(tmp_path, body, reason):
    before = set(sys.modules)
    assert reason in refusal(write_zip(tmp_path / "a.pth", pickled(body)))
    assert not {"torch", "ndf_robot"} & (set(sys.modules) - before)


def test_content_without_tensors_says_what_to_save(tmp_path):
    assert "got str; save" in refusal(write_zip(tmp_path / "a.pth", pickled(text("hello"))))
    assert "epoch (int)" in refusal(write_zip(tmp_path / "a.pth", pickled(dictionary({"epoch": integer(3)}))))
    array = called(named("numpy._core.multiarray", "_reconstruct"), text("x"))
    message = refusal(write_zip(tmp_path / "a.pth", pickled(dictionary({"decoder.fc_in.weight": array}))))
    assert "got decoder.fc_in.weight (numpy._core.multiarray._reconstruct)" in message


# --- tensors that claim too much ---


@pytest.mark.parametrize(
    ("claim", "reason"),
    [
        (tensor(storage("0", 2**40), (2**20, 2**20)), "claims a storage of"),
        (tensor(storage("0", 2**29), (4, 4)), "claims a storage of"),
        (tensor(storage("0", 16), (2**20, 2**20), (0, 0)), "does not lie in its storage"),
        (tensor(storage("0", 16), (4, 4), offset=1), "does not lie in its storage"),
        (tensor(storage("0", 16), (4, 4), (5, 1)), "does not lie in its storage"),
        (tensor(storage("0", 16), (0, 4)), "does not lie in its storage"),
        (tensor(storage("0", 16), (4, 4), offset=-1), "damaged"),
        (tensor(storage("0", 16), (4, 4), (-4, 1), offset=12), "damaged"),
        (tensor(storage("0", 16), (4, 4), (1,)), "damaged"),
        (tensor(storage("0", -1), (4, 4)), "damaged"),
        (tensor(storage("0", 16), (1,) * 9), "damaged"),
    ],
)
def test_tensors_that_do_not_lie_in_their_storage(tmp_path, claim, reason):
    path = write_zip(tmp_path / "a.pth", pickled(dictionary({"decoder.fc_in.weight": claim})), {"0": bytes(64)})
    assert reason in refusal(path)


def test_storage_of_another_size_than_claimed(tmp_path, weights):
    assert "bytes; expected" in refusal(write_checkpoint(tmp_path / "a.pth", weights, lambda x: x.tobytes()[:-4]))


def test_compressed_members_are_refused(tmp_path, weights):
    zeros = {name: np.zeros_like(array) for name, array in weights.items()}
    assert "compressed" in refusal(write_checkpoint(tmp_path / "a.pth", zeros, compression=zipfile.ZIP_DEFLATED))


def test_oversized_pickle_is_refused(tmp_path):
    assert "expected at most" in refusal(write_zip(tmp_path / "a.pth", pickled(b"N" * 2**21)))


# --- another architecture ---


def test_missing_extra_and_misshapen_tensors_are_reported_together(tmp_path, weights):
    changed = dict(weights)
    del changed["encoder.block_2.shortcut.map_to_feat.weight"]
    changed["encoder.block_5.fc_0.weight"] = np.zeros((2, 2), np.float32)
    changed["decoder.fc_in.weight"] = np.zeros((5, 9), np.float32)
    changed["decoder.block1.fc_0.bias"] = np.zeros(4, np.float32)
    message = refusal(write_checkpoint(tmp_path / "a.pth", changed))
    assert "1 missing: encoder.block_2.shortcut.map_to_feat.weight (128, 256)" in message
    assert "1 not expected: encoder.block_5.fc_0.weight (2, 2)" in message
    assert "2 of another shape" in message
    assert "decoder.fc_in.weight is (5, 9), expected (5, 7)" in message
    assert "decoder.block1.fc_0.bias is (4,), expected (5,)" in message


@pytest.mark.parametrize(
    "name", ["encoder.fc_c.map_to_feat.weight", "decoder.z_in.map_to_feat.weight", "decoder.fc_in.weight"]
)
def test_a_tensor_that_determines_the_latent_size_may_be_the_wrong_one(tmp_path, weights, name):
    changed = weights | {name: np.zeros(weights[name].shape[::-1], np.float32)[:2]}
    message = refusal(write_checkpoint(tmp_path / "a.pth", changed))
    assert "latent size 3" in message and f"1 of another shape: {name}" in message


@pytest.mark.parametrize("shape", [(), (1,), (2**28, 1), (1, 2**28), (2, 2, 2)])
def test_another_network_altogether(tmp_path, shape):
    names = ["fc.weight", "encoder.fc_c.map_to_feat.weight", "decoder.fc_in.weight", "decoder.fc_in.bias"]
    claim = tensor(storage("0", 2**28, "HalfStorage"), shape)
    path = write_zip(tmp_path / "a.pth", pickled(dictionary({name: claim for name in names})))
    assert "1 not expected: fc.weight" in refusal(path)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_non_finite_weights_are_named(tmp_path, weights, bad):
    changed = weights | {"decoder.fc_out.bias": np.float32([bad])}
    message = refusal(write_checkpoint(tmp_path / "a.pth", changed))
    assert "too large for float32: decoder.fc_out.bias; train or copy" in message


def test_double_beyond_single_precision_is_named(tmp_path, weights):
    changed = {name: array.astype("<f8") for name, array in weights.items()}
    changed["decoder.fc_out.bias"][0] = 1e300
    assert "decoder.fc_out.bias; train" in refusal(write_checkpoint(tmp_path / "a.pth", changed, kind="DoubleStorage"))


def test_whole_numbers_are_not_weights(tmp_path, weights):
    path = write_checkpoint(tmp_path / "a.pth", weights, lambda x: x.astype("<i8").tobytes(), "LongStorage")
    assert "holds int64 numbers" in refusal(path)


# --- damaged files and files of other kinds ---


@pytest.mark.parametrize("kept", [0.0001, 0.01, 0.5, 0.999])
def test_truncated_file(tmp_path, kept):
    content = (FIXTURES / "ndf_latent32.pth").read_bytes()
    (tmp_path / "a.pth").write_bytes(content[: int(kept * len(content))])
    assert "truncated" in refusal(tmp_path / "a.pth")


def test_every_flipped_byte_is_detected_or_harmless(tmp_path):
    """Nothing but an `InputError` is raised, and no other weights are read."""
    path, content = tmp_path / "a.pth", (FIXTURES / "ndf_latent32.pth").read_bytes()
    unchanged = flatten_dict(convert_checkpoint(FIXTURES / "ndf_latent32.pth").params, sep=".")
    rng = np.random.default_rng(1)
    # The pickle, the tensors, and most of all the directory at the end, where the zip reader has to make sense of it.
    size, refused = len(content), 0
    for place in [*rng.integers(0, 12000, 5), *rng.integers(0, size, 5), *rng.integers(size - 8000, size, 12)]:
        damaged = bytearray(content)
        damaged[place] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        try:
            model = convert_checkpoint(path)
        except InputError:
            refused += 1
            continue
        for name, leaf in flatten_dict(model.params, sep=".").items():
            np.testing.assert_array_equal(leaf, unchanged[name])
    assert refused >= 10  # the rest lay in time stamps, padding and the like


def test_flipped_bit_in_a_tensor_fails_the_checksum(tmp_path):
    content = bytearray((FIXTURES / "ndf_latent32.pth").read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / "a.pth").write_bytes(content)
    assert "CRC" in refusal(tmp_path / "a.pth")


@pytest.mark.filterwarnings("ignore:invalid escape sequence")  # pickletools' own, on what a damaged name contains
def test_random_pickles_are_refused_without_a_traceback(weights):
    parts = {name: tensor(storage("0", array.size), array.shape) for name, array in weights.items()}
    body = bytearray(pickled(dictionary(parts) + METADATA))
    rng = np.random.default_rng(2)
    refused = 0
    for _ in range(500):
        damaged = body.copy()
        for place in rng.integers(len(body), size=rng.integers(1, 4)):
            damaged[place] = rng.integers(256)
        try:
            interpret(bytes(damaged))
        except Refusal:
            refused += 1
    assert refused > 100


def test_missing_storage(tmp_path, weights):
    path = write_checkpoint(tmp_path / "whole.pth", weights)
    with zipfile.ZipFile(path) as whole, zipfile.ZipFile(tmp_path / "a.pth", "w") as part:
        for name in whole.namelist():
            if name != "archive/data/7":
                part.writestr(name, whole.read(name))
    assert "archive/data/7 is missing" in refusal(tmp_path / "a.pth")


def test_old_formats_say_how_to_save_again(tmp_path):
    advice = 'torch.save(torch.load(p, map_location="cpu"), new)'
    path = tmp_path / "a.pth"
    path.write_bytes(pickle.dumps(0x1950A86A20F9469CFC6C, 2) + pickle.dumps(1001, 2))
    assert advice in refusal(path)
    header = io.BytesIO(bytes(1024))
    header.seek(257)
    header.write(b"ustar")
    path.write_bytes(header.getvalue())
    assert advice in refusal(path)


@pytest.mark.parametrize(
    ("content", "advice"),
    [
        (b"", "expected a file from torch.save"),
        (b"hello", "expected a file from torch.save"),
        (bytes(1000), "expected a file from torch.save"),
        (b"\x93NUMPY", "a NumPy array"),
        (gzip.compress(b"x", mtime=0), "compressed by gzip; expected a file from torch.save: unpack it by gunzip"),
        (b"\n<!DOCTYPE html>", "a web page"),
        (b"<Error><Code>AccessDenied</Code></Error>", "it is XML, such as the message of a failed download"),
        (b"version https://git-lfs.github.com/spec/v1\n", "run git lfs pull"),
        (b'{"weight_map": {}}', "the index of a checkpoint in several files"),
        (b"\x89HDF\r\n", "it is an HDF5 file"),
        (b"\x89PNG\r\n", "it is a picture; expected a file from torch.save: name the PyTorch checkpoint"),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_not_a_checkpoint(tmp_path, content, advice):
    (tmp_path / "a.pth").write_bytes(content)
    message = refusal(tmp_path / "a.pth")
    assert "not a PyTorch checkpoint" in message and advice in message


def test_archives_around_a_checkpoint_and_other_archives(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("weights/ndf.pth", b"")
    assert "a zip archive with weights/ndf.pth in it; unpack it" in refusal(tmp_path / "a.zip")
    (tmp_path / "ndf.pth").write_bytes(b"x")
    with tarfile.open(tmp_path / "a.tar", "w") as archive:
        archive.add(tmp_path / "ndf.pth", "ndf.pth")
    assert "a tar archive with ndf.pth in it; unpack it" in refusal(tmp_path / "a.tar")
    np.savez(tmp_path / "a.npz", x=np.zeros(3))
    assert "a NumPy archive" in refusal(tmp_path / "a.npz")
    with zipfile.ZipFile(tmp_path / "a.pt2", "w") as archive:
        archive.writestr("export/archive_format", b"pt2")
        archive.writestr("export/data/sample.pt", b"")
    assert "torch.export" in refusal(tmp_path / "a.pt2")


def test_folders_and_shards(tmp_path, weights):
    assert "it is a folder, so there is no such file; expected a file from torch.save" in refusal(tmp_path)
    (tmp_path / "ndf.pth").touch()
    assert "one of those in it: ndf.pth" in refusal(tmp_path)
    (tmp_path / "__0_0.distcp").touch()
    assert f"dcp_to_torch {tmp_path} new.pth" in refusal(tmp_path)
    half = dict(list(weights.items())[::2])
    message = refusal(write_checkpoint(tmp_path / "pytorch_model-00001-of-00002.bin", half))
    assert f"{len(weights) - len(half)} missing" in message and "one of several files of a checkpoint" in message


def test_unknown_byte_order(tmp_path, weights):
    path = write_checkpoint(tmp_path / "a.pth", weights, records={"byteorder": b"middle"})
    assert "expected little or big" in refusal(path)


def test_missing_file_and_other_zip(tmp_path):
    assert "no such file" in refusal(tmp_path / "nowhere.pth")
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("readme.txt", "hello")
    assert "found 0" in refusal(tmp_path / "a.zip")
