import dataclasses
import json
import re
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors
import safetensors.numpy
from flax.traverse_util import flatten_dict, unflatten_dict

from tdf_jax._internal.errors import InputError
from tdf_jax.networks import checkpoint
from tdf_jax.networks.checkpoint import available_models, load_model, save_model
from tdf_jax.networks.model import Model, ModelInfo, fingerprint
from tdf_jax.networks.occupancy import NetworkConfig, parameter_shapes

CONFIG = NetworkConfig(
    latent=2,
    vector_hidden=3,
    vector_width=6,
    decoder_width=4,
    blocks=1,
    neighbours=3,
    scaling=7.5,
    symmetry_breaking_offset=0.1,
)


def make_model(**info):
    rng = np.random.default_rng(0)
    # Transposed views, as a conversion from PyTorch gives them: only the logical order may reach the file.
    flat = {name: rng.normal(size=shape[::-1]).astype(np.float32).T for name, shape in parameter_shapes(CONFIG).items()}
    return Model(unflatten_dict(flat, sep="."), CONFIG, ModelInfo(**{"name": "mug", "source": "a test", **info}))


def altered(name, array):
    flat = flatten_dict(make_model().params, sep=".") | {name: array}
    return dataclasses.replace(make_model(), params=unflatten_dict(flat, sep="."))


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "mug.safetensors"
    save_model(make_model(cloud_points=256, description="round"), path)
    return path


def rewrite(path, change=lambda tensors: None, header=None, checksum=False):
    """Change a saved file's tensors and header fields; `checksum` makes it consistent again, as a forger would."""
    with safetensors.safe_open(path, framework="numpy") as file:
        fields = json.loads(file.metadata()["tdf_jax"])
        tensors = {name: file.get_tensor(name).copy() for name in file.keys()}
    change(tensors)
    fields.update(header or {})
    if checksum:
        fields["sha256"] = checkpoint._checksum(fields, tensors)
    path.write_bytes(safetensors.numpy.save(tensors, {"tdf_jax": json.dumps(fields)}))


def refusal(path):
    with pytest.raises(InputError) as caught:
        load_model(path)
    message = str(caught.value)
    assert message.startswith("load_model(): ")
    return message


def test_a_model_survives_the_file(saved):
    model, loaded = make_model(cloud_points=256, description="round"), load_model(str(saved))
    assert (loaded.config, loaded.info) == (model.config, model.info)
    assert jax.tree.structure(loaded.params) == jax.tree.structure(model.params)
    for before, after in zip(jax.tree.leaves(model.params), jax.tree.leaves(loaded.params), strict=True):
        assert isinstance(after, jax.Array) and after.dtype == jnp.float32
        np.testing.assert_array_equal(before, after)


def test_a_file_from_before_there_was_an_offset_has_none(saved):
    before = {name: value for name, value in dataclasses.asdict(CONFIG).items() if name != "symmetry_breaking_offset"}
    rewrite(saved, header={"schema": 1, "config": before}, checksum=True)
    assert load_model(saved).config == dataclasses.replace(CONFIG, symmetry_breaking_offset=0.0)


def test_a_file_of_the_release_before_has_its_offset_under_the_former_name(saved):
    former = {
        "asymmetry" if name == "symmetry_breaking_offset" else name: value for name, value in vars(CONFIG).items()
    }
    rewrite(saved, header={"schema": 1, "config": former}, checksum=True)
    model = load_model(saved)
    assert model.config == CONFIG
    save_model(model, saved)
    with safetensors.safe_open(saved, framework="numpy") as file:
        header = json.loads(file.metadata()["tdf_jax"])
    assert header["schema"] == 3 and header["config"] == dataclasses.asdict(CONFIG)


@pytest.mark.parametrize(
    ("name", "start"), [("mug", "ad4cf37f70e26018"), ("bowl", "eba207d7d2f47251"), ("multi", "8071e18edf10a401")]
)
def test_fingerprints_of_shipped_weights_stay_because_they_name_results_on_disk(name, start):
    assert fingerprint(load_model(name)).startswith(start)


def test_unknown_cloud_points_and_whole_number_scaling_survive(tmp_path):
    model = dataclasses.replace(make_model(), config=dataclasses.replace(CONFIG, scaling=10))
    save_model(model, tmp_path / "a.safetensors")
    loaded = load_model(tmp_path / "a.safetensors")
    assert loaded.info.cloud_points is None and loaded.config == model.config


def test_equal_models_are_equal_files(tmp_path, saved):
    for attempt in range(5):
        path = tmp_path / f"{attempt}.safetensors"
        save_model(load_model(saved), path)
        assert path.read_bytes() == saved.read_bytes()


def test_the_model_does_not_depend_on_the_file(saved):
    model = load_model(saved)
    with saved.open("r+b") as file:  # in place, the same inode
        file.seek(-400, 2)
        file.write(bytes(400))
    for before, after in zip(jax.tree.leaves(make_model().params), jax.tree.leaves(model.params), strict=True):
        np.testing.assert_array_equal(before, after)


def test_a_model_is_a_pytree_with_static_sizes():
    model = make_model()
    doubled = jax.jit(lambda model: jax.tree.map(lambda leaf: 2 * leaf, model))(model)
    assert (doubled.config, doubled.info) == (model.config, model.info)
    assert len(jax.tree.leaves(model)) == len(parameter_shapes(CONFIG))
    before, after = (m.params["decoder"]["fc_in"]["kernel"] for m in (model, doubled))
    np.testing.assert_array_equal(after, 2 * before)


# --- names ---


def installed(monkeypatch, root, direct_url):
    """As if the package were in `root`, installed as its metadata say."""
    monkeypatch.setattr(checkpoint.resources, "files", lambda name: root / name)
    monkeypatch.setattr(
        checkpoint.metadata, "distribution", lambda name: SimpleNamespace(read_text=lambda file: direct_url)
    )


@pytest.mark.parametrize("folder", ["weights", "tdf_jax/weights"], ids=["checkout", "wheel"])
def test_shipped_weights_are_found_by_name(tmp_path, monkeypatch, folder):
    editable = json.dumps({"url": tmp_path.as_uri(), "dir_info": {"editable": True}})
    installed(monkeypatch, tmp_path, editable if folder == "weights" else None)
    (tmp_path / folder).mkdir(parents=True)
    (tmp_path / folder / "mug.md").write_text("# model card")
    for name in ("mug", "bowl"):
        save_model(make_model(name=name), tmp_path / folder / f"{name}.safetensors")
    assert available_models() == ("bowl", "mug")
    assert load_model("bowl").info.name == "bowl"
    assert "'mugs'" in refusal("mugs") and "(bowl, mug)" in refusal("mugs")
    assert "there are no weights ''" in refusal("")
    assert "there is no file" in refusal("./mug") and "(bowl, mug)" in refusal("./mug")


def test_no_shipped_weights(tmp_path, monkeypatch):
    installed(monkeypatch, tmp_path, json.dumps({"url": tmp_path.as_uri(), "dir_info": {}}))
    assert available_models() == ()
    assert "(none)" in refusal("mug")


# --- files that are not a model ---


def test_missing_file_and_directory(tmp_path):
    assert "there is no file" in refusal(tmp_path / "nowhere.safetensors")
    assert "there is no file" in refusal(tmp_path)


@pytest.mark.parametrize(
    "change",
    [lambda c: c[:-1], lambda c: c[: len(c) // 2], lambda c: c[:4], lambda c: b"", lambda c: c + b"\0"],
    ids=["last byte", "half", "length", "all", "trailing"],
)
def test_truncated_and_trailing_bytes(saved, change):
    saved.write_bytes(change(saved.read_bytes()))
    assert "not a valid safetensors file" in refusal(saved)


def test_every_flipped_bit_is_detected(saved):
    content = saved.read_bytes()
    header = 8 + int.from_bytes(content[:8], "little")
    rng = np.random.default_rng(0)
    # Most of them in the header: names, shapes, the config, the checksum itself.
    for place in [*range(8), *rng.integers(8, header, 40), *rng.integers(header, len(content), 6)]:
        damaged = bytearray(content)
        damaged[place] ^= 1 << rng.integers(8)
        saved.write_bytes(damaged)
        refusal(saved)


def test_a_flipped_bit_in_the_weights_is_a_checksum_error(saved):
    content = bytearray(saved.read_bytes())
    content[-2] ^= 1
    saved.write_bytes(content)
    assert "checksum" in refusal(saved)


@pytest.mark.parametrize("field", ["config", "info"])
def test_the_checksum_covers_what_is_not_a_tensor(saved, field):
    values = {"config": dataclasses.asdict(CONFIG) | {"slope": 0.3}, "info": {"name": "mug", "source": "someone else"}}
    rewrite(saved, header={field: values[field]})
    assert "checksum" in refusal(saved)


def test_other_safetensors_files(tmp_path):
    path = tmp_path / "a.safetensors"
    headers = [{"tdf_jax": text} for text in ("{", "[]", '{"schema": 1}', "[" * 100_000)]
    for metadata in (None, {"format": "pt"}, *headers):
        path.write_bytes(safetensors.numpy.save({"x": np.zeros(3)}, metadata))
        assert "no metadata of tdf_jax" in refusal(path)


def test_pytorch_file_points_to_the_converter(tmp_path):
    (tmp_path / "a.pth").write_bytes(b"PK\x03\x04" + bytes(100))
    assert "tdf convert" in refusal(tmp_path / "a.pth")


def test_newer_schema(saved):
    rewrite(saved, header={"schema": 4}, checksum=True)
    assert "schema is 4; expected 1 or 2 or 3" in refusal(saved)


def test_missing_extra_and_misshapen_tensors_are_all_named(saved):
    def change(tensors):
        del tensors["encoder.fc_pos.map_to_feat.kernel"]
        tensors["decoder.block7.fc_0.bias"] = np.zeros(4, np.float32)
        tensors["decoder.fc_out.kernel"] = np.zeros((1, 4), np.float32)

    for checksum in (False, True):
        rewrite(saved, change if not checksum else lambda tensors: None, checksum=checksum)
        message = refusal(saved)
        assert "1 missing: encoder.fc_pos.map_to_feat.kernel (3, 6)" in message
        assert "1 not expected: decoder.block7.fc_0.bias (4,)" in message
        assert "1 of another shape: decoder.fc_out.kernel is (1, 4), expected (4, 1)" in message


def test_tensors_of_another_type(saved):
    def change(tensors):
        tensors["decoder.fc_out.bias"] = tensors["decoder.fc_out.bias"].astype(np.float16)

    rewrite(saved, change, checksum=True)
    assert "expected F32 tensors, got decoder.fc_out.bias F16" in refusal(saved)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_non_finite_weights_are_named(saved, bad):
    def change(tensors):
        tensors["decoder.fc_in.kernel"][1, 1] = bad

    rewrite(saved, change, checksum=True)
    assert "NaN or infinite values in decoder.fc_in.kernel;" in refusal(saved)


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [
        ("config", {"latent": "many"}, "its NetworkConfig(): latent is 'many'; expected a whole number"),
        ("config", {"latent": True}, "latent is True; expected a whole number"),
        ("config", {"latent": 0}, "latent is 0; expected a whole number of at least 1"),
        ("config", {"blocks": 10**9}, "cannot be those of"),
        ("config", {"depth": 3}, "expected fields"),
        ("config", {}, "not those of its network"),
        ("config", [], "expected fields"),
        ("config", 3, "expected fields"),
        ("info", {"name": "mug"}, "expected fields"),
        ("info", {"name": "mug", "source": 3}, "ModelInfo.source is a int"),
        ("info", {"name": "mug", "source": "a", "cloud_points": "all"}, "ModelInfo.cloud_points is a str"),
    ],
)
def test_headers_that_describe_no_model(saved, field, value, reason):
    rewrite(saved, header={field: value}, checksum=True)
    with pytest.raises(InputError, match=rf"(?s)^load_model\(\): .*{re.escape(reason)}"):
        load_model(saved)


# --- models that cannot be written ---


@pytest.mark.parametrize(
    ("model", "reason"),
    [
        (lambda: altered("decoder.fc_out.bias", np.zeros(1)), "got decoder.fc_out.bias float64"),
        (
            lambda: altered("decoder.fc_out.bias", np.float32([np.nan])),
            "NaN or infinite values in decoder.fc_out.bias",
        ),
        (
            lambda: altered("decoder.fc_out.bias", np.zeros(2, np.float32)),
            "decoder.fc_out.bias is (2,), expected (1,)",
        ),
        (lambda: altered("decoder.extra", np.zeros(2, np.float32)), "not expected: decoder.extra"),
        (lambda: make_model(cloud_points=2.5), "ModelInfo.cloud_points is a float"),
    ],
)
def test_what_could_not_be_loaded_is_not_saved(saved, model, reason):
    before = saved.read_bytes()
    with pytest.raises(InputError, match=rf"(?s)^save_model\(\): .*{re.escape(reason)}"):
        save_model(model(), saved)
    assert saved.read_bytes() == before


@pytest.mark.parametrize(
    "place", ["mug", "mug.pth", "nowhere/mug.safetensors", "file/mug.safetensors", "folder.safetensors"]
)
def test_paths_that_cannot_be_written(tmp_path, place):
    (tmp_path / "file").write_text("not a folder")
    (tmp_path / "folder.safetensors").mkdir()
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError, match=r"^save_model\(\): "):
        save_model(make_model(), tmp_path / place)
    assert sorted(tmp_path.rglob("*")) == before


def test_an_interrupted_write_leaves_the_old_file(saved, monkeypatch):
    before = saved.read_bytes()

    def full_disk(source, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint.os, "replace", full_disk)
    with pytest.raises(InputError, match="No space left"):
        save_model(make_model(name="other"), saved)
    assert saved.read_bytes() == before
    assert list(saved.parent.iterdir()) == [saved]
