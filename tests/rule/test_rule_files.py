"""Rules survive their files, the authors' formats mean what ours do, and bad files are refused."""

import base64
import json
import math
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from support.refusals import Trap, refused
from support.worlds import relative_error

from npa_envs.errors import NPAError
from npa_envs.rule.files import load_rule, preset_rules, rule_metadata, save_rule, shipped_rules
from npa_envs.rule.paper_formats import save_demo_json
from npa_envs.rule.rule import HYPER_PARAMETERS, NPARule

RULES = {
    "plain 2D": lambda: NPARule(),
    "3D with read-out": lambda: NPARule(
        3, 5, 7, eps0=0.12, alpha=1.0, readout_dim=4, readout_hidden_dim=6
    ),
    "static": lambda: NPARule(2, 4, 8, static=True, readout_dim=10, readout_hidden_dim=3),
    "ablated": lambda: NPARule(
        2, 6, 5, moment_correction=False, state_gradient=False, density_gradient=False
    ),
    "smooth": lambda: NPARule(moment_inverse="smooth", dead_zone=0.001),
    "equivariant": lambda: NPARule(3, 5, 7, equivariant=True, mixed_vectors=3),
    "chiral": lambda: NPARule(2, 5, 7, equivariant=True, chiral=True, density_gradient=False),
}


def assert_same_rule(got, expected):
    assert got.hyper_parameters() == expected.hyper_parameters()
    state = expected.state_dict()
    assert got.state_dict().keys() == state.keys()
    for name, tensor in got.state_dict().items():
        assert tensor.dtype == state[name].dtype
        assert torch.equal(tensor, state[name]), name


@pytest.mark.parametrize("case", RULES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_saved_rule_comes_back_bit_by_bit(tmp_path, case, dtype):
    rule = RULES[case]().to(dtype)
    save_rule(rule, tmp_path / "rule.safetensors")
    before = torch.get_rng_state()
    loaded = load_rule(tmp_path / "rule.safetensors")
    assert torch.equal(before, torch.get_rng_state())
    assert_same_rule(loaded, rule)
    # It does not hang on its file; one that is compiled is saved as the rule that it is.
    save_rule(NPARule(), tmp_path / "rule.safetensors")
    assert_same_rule(loaded, rule)
    save_rule(torch.compile(loaded, backend="eager"), tmp_path / "rule.safetensors")
    assert_same_rule(load_rule(tmp_path / "rule.safetensors"), rule)
    assert all(p.requires_grad for p in loaded.parameters())
    z = torch.randn(3, rule.perception_dim, dtype=dtype)
    assert torch.equal(loaded(z), rule(z))


def test_a_runs_folder_stands_for_its_rule(tmp_path):
    refused(r"a folder must hold the rule\.safetensors of a run", load_rule, tmp_path)
    save_rule(NPARule(), tmp_path / "rule-0.safetensors")
    refused(r"name one of its rules, such as .*rule-0\.safetensors", load_rule, tmp_path)
    save_rule(rule := NPARule(), tmp_path / "rule.safetensors")
    assert_same_rule(load_rule(tmp_path), rule)


def test_metadata_is_kept_and_holds_every_hyper_parameter(tmp_path):
    path = tmp_path / "rule.safetensors"
    save_rule(NPARule(eps0=0.125), path, metadata={"trained": "10 000 iterations, ε = 0.125"})
    metadata = rule_metadata(path)
    assert metadata["trained"] == "10 000 iterations, ε = 0.125"
    assert (metadata["format"], metadata["version"]) == ("npa-envs rule", "1")
    assert metadata["eps0"] == "0.125"
    assert metadata["static"] == "false"
    assert set(HYPER_PARAMETERS) <= set(metadata)


@pytest.mark.parametrize(
    ("name", "metadata", "message"),
    [
        ("rule.pth", {}, r"must end in \.safetensors"),
        ("rule.safetensors", {"eps0": "1"}, "must not use the name 'eps0'"),
        ("rule.safetensors", {"steps": 3}, "must map text to text"),
        ("rule.safetensors", {"a": "\ud800"}, r"UTF-8 can write, got 'a': '\\ud800': leave"),
        ("rule.safetensors", {"\ud800": "a"}, r"UTF-8 can write, got '\\ud800': 'a': leave"),
    ],
)
def test_metadata_that_could_not_be_loaded_is_refused(tmp_path, name, metadata, message):
    refused(message, save_rule, NPARule(), tmp_path / name, metadata=metadata)
    assert list(tmp_path.iterdir()) == []


class Threefold(NPARule):
    def forward(self, z):
        return 3.0 * super().forward(z)


class Sine(torch.nn.Linear):
    def forward(self, z):
        return torch.sin(super().forward(z))


CHANGED = {
    "another forward": lambda rule: setattr(rule, "__class__", Threefold),
    "normed weights": lambda rule: torch.nn.utils.parametrizations.weight_norm(rule.hidden),
    "a layer of another class": lambda rule: setattr(rule, "hidden", Sine(rule.input_dim, 8)),
    "another activation": lambda rule: setattr(rule.readout, "1", torch.nn.Tanh()),
    "a replaced forward": lambda rule: vars(rule).update(forward=torch.sin),
    "a layer's replaced forward": lambda rule: vars(rule.hidden).update(forward=torch.sin),
    "a hook of a layer": lambda rule: rule.hidden.register_forward_hook(lambda m, i, o: 2.0 * o),
    "a hook before a layer": lambda rule: rule.readout[0].register_forward_pre_hook(lambda m, i: i),
    "a hook of the rule": lambda rule: rule.register_forward_hook(lambda m, i, o: 2.0 * o),
    "no biases": lambda rule: setattr(rule.hidden, "bias", None),
}
NETWORK = r"network of NPARule.*remove its hooks, or keep"
PRECISION = r"all float32 or all float64, got .{}.: convert them, as rule\.float\(\) does"
UNSAVED = {
    **{case: (change, NETWORK) for case, change in CHANGED.items()},
    "half": (NPARule.half, PRECISION.format("'torch.float16'")),
    "bfloat16": (NPARule.bfloat16, PRECISION.format("'torch.bfloat16'")),
    "mixed": (lambda r: r.output.double(), PRECISION.format("'torch.float32', 'torch.float64'")),
    "NaN": (
        lambda rule: rule.output.weight.data[0, :2].fill_(math.nan),
        r"2 of \d+ numbers in 'out",
    ),
}
"""Changes of a rule that its file could not hold, and the message."""


@pytest.mark.parametrize("case", UNSAVED)
@pytest.mark.parametrize("equivariant", [False, True])
def test_a_rule_that_would_be_loaded_as_another_is_not_saved(tmp_path, case, equivariant):
    change, message = UNSAVED[case]
    path = tmp_path / "rule.safetensors"
    path.write_bytes(b"as it was")
    rule = NPARule(2, 4, 8, readout_dim=3, readout_hidden_dim=5, equivariant=equivariant)
    change(rule)
    refused(message, save_rule, rule, path)
    assert path.read_bytes() == b"as it was"
    assert list(tmp_path.iterdir()) == [path]


def test_what_does_not_change_a_network_does_not_keep_it_from_its_file(tmp_path):
    rule = NPARule(2, 4, 8)
    rule.noted = torch.nn.ReLU()
    rule.noted.register_forward_hook(lambda m, i, o: None)
    rule.hidden.register_full_backward_hook(lambda m, i, o: None)
    save_rule(rule, tmp_path / "rule.safetensors")
    assert_same_rule(load_rule(tmp_path / "rule.safetensors"), rule)


def test_rules_of_the_package_are_loaded_without_a_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rules = {name: load_rule(name) for name in shipped_rules() | preset_rules()}
    # What older files do not say.
    assert rules["gecko"].moment_inverse == "threshold"
    assert rules["heart-first"].dead_zone == 0.0


def test_no_bit_flips_unnoticed(tmp_path):
    rule, path = NPARule(2, 3, 8, eps0=0.1), tmp_path / "rule.safetensors"
    save_rule(rule, path, metadata={"trained": "10 000 iterations"})
    data, metadata_before = path.read_bytes(), rule_metadata(path)
    rejected = 0
    for place in np.random.default_rng(0).integers(8 * len(data), size=250).tolist():
        flipped = bytearray(data)
        flipped[place // 8] ^= 1 << place % 8
        path.write_bytes(flipped)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                loaded = load_rule(path)
        except (NPAError, UserWarning):
            rejected += 1
        else:  # A space after the header.
            assert rule_metadata(path) == metadata_before
            assert_same_rule(loaded, rule)
    assert rejected >= 245


def write_ours(path, change):
    """Write a file as `save_rule` does, with the header and the weights changed."""
    rule = NPARule()
    save_rule(rule, path)
    header = rule_metadata(path)
    weights = {name: tensor.clone() for name, tensor in rule.state_dict().items()}
    change(header, weights)
    save_file(weights, path, metadata=header)


BAD_HEADERS = {
    "unknown version": (lambda h, w: h.update(version="2"), "version must be 1, got '2'.*upgrade"),
    "another format": (lambda h, w: h.update(format="llama"), "format must be 'npa-envs rule'"),
    "no format": (lambda h, w: h.pop("format"), "format must be 'npa-envs rule', got None"),
    "no checksum": (lambda h, w: h.pop("checksum"), "checksum must be .* damaged.*copy it again"),
    "a weight": (lambda h, w: w["hidden.bias"].add_(1e-3), "checksum must .* damaged.*copy it aga"),
    "a missing key": (lambda h, w: h.pop("alpha"), "lacks 'alpha'"),
    "a wrong type": (lambda h, w: h.update(static="0"), "'static' must be a JSON bool, got '0'"),
    "no JSON": (lambda h, w: h.update(eps0="0,1"), "'eps0' must be a JSON float"),
    "a wrong value": (lambda h, w: h.update(space_dim="4"), "space_dim must be 2 or 3"),
    "a wrong word": (lambda h, w: h.update(moment_inverse='"smoosh"'), "got 'smoosh'"),
    "huge radius": (lambda h, w: h.update(eps0="9" * 400), "'eps0' must be a JSON float"),
    "NaN radius": (lambda h, w: h.update(eps0="NaN"), "eps0 must be positive and finite"),
    "a huge size": (lambda h, w: h.update(hidden_dim="9" * 30), "at most 65536, got"),
    "another shape": (lambda h, w: h.update(hidden_dim="64"), r"\(128, 66\) instead of \(64, 66\)"),
    "a missing weight": (lambda h, w: w.pop("hidden.bias"), "hidden.bias: missing"),
    "a weight too many": (lambda h, w: w.update(extra=torch.ones(1)), "extra: .* instead of"),
    "whole numbers": (
        lambda h, w: w.update({k: v.to(torch.int32) for k, v in w.items()}),
        "float32 or all float64, got .'torch.int32'",
    ),
    "mixed precision": (lambda h, w: w.update({"hidden.bias": w["hidden.bias"].double()}), "all"),
    "infinite weights": (lambda h, w: w["hidden.bias"].fill_(math.inf), "128 of 128 numbers"),
}


BIAS = "model.0.bias"


def authors_state(rule):
    state = {
        "model.0.weight": rule.hidden.weight.detach(),
        "model.0.bias": rule.hidden.bias.detach(),
        "model.2.weight": rule.output.weight.detach(),
        "eps0": torch.tensor(rule.eps0),
        "N0": torch.tensor(4096),
        "alpha": torch.tensor(rule.alpha),
    }
    if rule.readout is not None:
        for name, tensor in rule.readout.state_dict().items():
            state[f"decoder.{name}"] = tensor
    return state


@pytest.mark.parametrize("case", ["plain 2D", "3D with read-out", "static"])
def test_the_authors_state_dict_is_the_same_rule(tmp_path, case):
    rule = RULES[case]()
    state = authors_state(rule)
    torch.save(state, tmp_path / "npa.pth")
    assert_same_rule(load_rule(tmp_path / "npa.pth"), rule)
    # Convolutions and plain numbers are read as well.
    state |= {"eps0": rule.eps0, "alpha": rule.alpha}
    for name in ("model.0.weight", "model.2.weight"):
        state[name] = state[name][:, :, None, None]
    torch.save(state, tmp_path / "npa.pth")
    assert_same_rule(load_rule(tmp_path / "npa.pth"), rule)


@pytest.mark.parametrize(
    ("is_zip", "message"),
    [
        (True, "holds objects other than tensors, which could run code: export"),
        (False, "is damaged, or holds objects other than tensors"),
    ],
)
def test_code_in_a_state_dict_is_not_run(tmp_path, is_zip, message):
    state = {"model.0.weight": Trap(tmp_path / "ran")}
    torch.save(state, tmp_path / "npa.pth", _use_new_zipfile_serialization=is_zip)
    with pytest.raises(NPAError, match=message) as caught:
        load_rule(tmp_path / "npa.pth")
    assert "weights_only" not in str(caught.value)
    assert not (tmp_path / "ran").exists()


def test_rules_saved_by_torch_are_refused_with_what_saves_them(tmp_path):
    for saved in (NPARule(), NPARule().state_dict()):
        torch.save(saved, tmp_path / "b.pth")
        refused(r"save.*rule.*npa_envs\.save_rule", load_rule, tmp_path / "b.pth")


def test_a_changed_byte_in_a_state_dict_is_noticed_and_the_legacy_format_is_read(tmp_path):
    rule = NPARule()
    path = tmp_path / "npa.pth"
    torch.save(authors_state(rule), path)
    data = bytearray(path.read_bytes())
    data[data.index(rule.hidden.weight.detach().numpy().tobytes()) + 1000] ^= 1
    path.write_bytes(data)
    refused(r"npa\.pth.*damaged \(wrong checksum of .*again", load_rule, path)
    torch.save(authors_state(rule), path, _use_new_zipfile_serialization=False)
    with pytest.warns(UserWarning, match=r"npa\.pth' has no checksum.*save it again"):
        assert_same_rule(load_rule(path), rule)


BAD_STATES = {
    "a missing key": (lambda s: s.pop("alpha"), r"missing: \['alpha'\].*: .*give the npa\.pth"),
    "an unknown key": (lambda s: s.update({"model.2.bias": torch.ones(18)}), "model.2.bias"),
    "half a decoder": (lambda s: s.update({"decoder.0.bias": torch.ones(3)}), "decoder.2.weight"),
    "no tensor": (lambda s: s.update({BIAS: [1.0]}), "must be a tensor, got a list"),
    "a wrong rank": (lambda s: s.update({BIAS: torch.ones(128, 1)}), "1 dimension"),
    "a wrong size": (lambda s: s.update({BIAS: torch.ones(64)}), "shapes"),
    "odd inputs": (lambda s: s.update({"model.0.weight": torch.ones(128, 65)}), "65 inputs"),
    "odd outputs": (lambda s: s.update({"model.2.weight": torch.ones(17, 128)}), "17 outputs"),
    "no radius": (lambda s: s.update(eps0=torch.tensor(math.nan)), "eps0 must be finite"),
    "NaN weights": (lambda s: s[BIAS].fill_(math.nan), "must be finite"),
    "sparse weights": (lambda s: s.update({BIAS: s[BIAS].to_sparse()}), f"{BIAS} must be a dense"),
    "meta weights": (lambda s: s.update({BIAS: s[BIAS].to("meta")}), f"{BIAS} must be a dense ten"),
    "a meta number": (lambda s: s.update(eps0=s["eps0"].to("meta")), "eps0 must be a dense tensor"),
    "a huge number": (lambda s: s.update(alpha=10**400), "alpha must be a number, got 1000"),
}


def pack(array):
    array = np.ascontiguousarray(array, dtype="<f4")
    text = base64.b64encode(array.tobytes()).decode()
    return {"shape": list(array.shape), "dtype": "float32", "data64": text}


def ones(*shape):
    return pack(np.ones(shape))


def padded(tensor):
    """Return a tensor whose rows are padded with zeros to a multiple of four numbers."""
    return torch.nn.functional.pad(tensor.detach(), (0, -tensor.shape[-1] % 4))


def demo_tensors(rule):
    """Return the tensors of a rule as the web demo has them: rows of displacement come last."""
    output = rule.output.weight
    return {
        "w1.weight": padded(rule.hidden.weight),
        "w1.bias": rule.hidden.bias.detach(),
        "w2.weight.T": padded(torch.cat([output[2:], output[:2]]).T),
    }


def demo_entry(tensors):
    arrays = {name: pack(tensor) for name, tensor in tensors.items()}
    return arrays | {"eps0": float(np.float32(0.1)), "N0": 4096, "alpha": 0.5}


def demo_stack(rules):
    """Return the JSON of a stack of rules: each array has one more dimension, the rules."""
    return demo_entry({name: torch.stack([rule[name] for rule in rules]) for name in rules[0]})


def write_json(path, content):
    path.write_text(json.dumps(content), encoding="utf-8")


@pytest.mark.parametrize("state_dim", [16, 5])
def test_rules_of_the_web_demo_are_the_same_rules(tmp_path, state_dim):
    rules, path = [NPARule(state_dim=state_dim) for _ in range(3)], tmp_path / "models.json"
    tensors = [demo_tensors(rule) for rule in rules]
    for content in ({"mine": demo_entry(tensors[0])}, demo_stack(tensors[:1])):
        write_json(path, content)
        assert_same_rule(load_rule(path), rules[0])
    stack, several = demo_stack(tensors), "several rules: add #name; names: "
    for content, names, unknown in (
        ({name: demo_entry(t) for name, t in zip("abc", tensors, strict=True)}, "a, b, c", ("d",)),
        (stack, "0, 1, 2", ("3", "-1", "lizard", "", "9" * 5000)),
    ):
        write_json(path, content)
        for name, rule in zip(names.split(", "), rules, strict=True):
            assert_same_rule(load_rule(f"{path}#{name}"), rule)
        refused(f"{several}{names}", load_rule, path)
        for name in unknown:
            refused(f"no rule '{name[:20]}.*known: {names}", load_rule, f"{path}#{name}")
    write_json(path, {"mine": demo_entry(tensors[0]), "other": demo_entry(tensors[1])})
    refused("no rule 'mina': did you mean 'mine'", load_rule, f"{path}#mina")


def equivariant_state(seed=0, state_dim=3, mixed=2, hidden_dim=5):
    """Return random tensors of an equivariant rule by their names in the authors' state dict."""
    generator = torch.Generator().manual_seed(seed)
    inputs, outputs = 2 * state_dim + mixed * (mixed + 1) // 2, state_dim + mixed
    shapes = {
        "model.W_hidden": (state_dim + 1, mixed),
        "model.W_out": (mixed, 1),
        "model.mlp.0.weight": (hidden_dim, inputs),
        "model.mlp.0.bias": (hidden_dim,),
        "model.mlp.2.weight": (outputs, hidden_dim),
        "model.mlp.2.bias": (outputs,),
    }
    state = {name: torch.randn(shape, generator=generator) for name, shape in shapes.items()}
    return state | {"eps0": torch.tensor(0.1), "N0": torch.tensor(4096), "alpha": torch.tensor(0.5)}


def equivariant_update(state, z):
    """Return [δ ; Δs] of perception vectors, written out pair by pair."""
    mixing, steering = state["model.W_hidden"], state["model.W_out"]
    channels, mixed = mixing.shape[0] - 1, mixing.shape[1]
    vectors = z[:, 2 * channels :].view(len(z), channels + 1, 2)
    u = [sum(mixing[i, a] * vectors[:, i] for i in range(channels + 1)) for a in range(mixed)]
    products = [(u[a] * u[b]).sum(-1) for a in range(mixed) for b in range(a, mixed)]
    inputs = torch.cat((z[:, : 2 * channels], torch.stack(products, dim=1)), dim=1)
    hidden = torch.relu(inputs @ state["model.mlp.0.weight"].T + state["model.mlp.0.bias"])
    y = hidden @ state["model.mlp.2.weight"].T + state["model.mlp.2.bias"]
    gates = torch.relu(y[:, channels:])
    delta = sum(u[a] * gates[:, a : a + 1] * steering[a, 0] for a in range(mixed))
    return torch.cat((delta, y[:, :channels]), dim=1)


def equivariant_tensors(state):
    """Return the tensors as the web demo has them: padded, weights of mixed vectors four times."""
    return {
        "W_hidden": state["model.W_hidden"].repeat_interleave(4, dim=-1),
        "W_out": state["model.W_out"].repeat_interleave(4, dim=-1),
        "w1.weight": padded(state["model.mlp.0.weight"]),
        "w1.bias": padded(state["model.mlp.0.bias"]),
        "w2.weight": padded(state["model.mlp.2.weight"]),
        "w2.bias": padded(state["model.mlp.2.bias"]),
    }


def test_the_authors_equivariant_rules_run_as_theirs(tmp_path):
    states = [equivariant_state(seed) for seed in range(3)]
    torch.save(states[0], tmp_path / "npa.pth")
    tensors = [equivariant_tensors(state) for state in states]
    write_json(tmp_path / "a.json", {f"{k}": demo_entry(t) for k, t in enumerate(tensors)})
    write_json(tmp_path / "b.json", demo_stack(tensors))
    for name, k in (("npa.pth", 0), *((f"{f}.json#{k}", k) for f in "ab" for k in range(3))):
        rule = load_rule(f"{tmp_path / name}")
        z = torch.randn(30, rule.perception_dim, generator=torch.Generator().manual_seed(8))
        assert (rule.space_dim, rule.eps0, rule.alpha) == (2, 0.1, 0.5)
        assert relative_error(rule(z), equivariant_update(states[k], z)) < 1e-6


BAD_ENTRIES = {
    "a missing array": (lambda e: e.pop("w1.bias"), "lacks 'w1.bias'"),
    "no base64": (lambda e: e["w1.bias"].update(data64="!!"), "no base64"),
    "cut data": (lambda e: e["w1.bias"].update(data64="AAAA"), "512 bytes for shape .*, got 3"),
    "another dtype": (lambda e: e["w1.bias"].update(dtype="float16"), "must be float32"),
    "a bad shape": (lambda e: e["w1.bias"].update(shape=[-1]), "must be float32 with 1 dim"),
    "shapes at odds": (lambda e: e.update({"w2.weight.T": pack(np.ones((128, 16)))}), "must agree"),
    "a huge radius": (lambda e: e.update(eps0=10**400), "eps0 must be a number, got 1000"),
    "no radius": (lambda e: e.pop("eps0"), "eps0 must be a number, got None"),
    "NaN weights": (lambda e: e.update({"w1.bias": pack(np.full(128, np.nan))}), "must be finite"),
}


BAD_EQUIVARIANT = {
    "a missing tensor": (lambda e: e.pop("w2.bias"), "lacks 'w2.bias'"),
    "fewer mixtures": (lambda e: e.update(W_out=ones(1, 4)), "must have the sh"),
    "few inputs": (lambda e: e.update({"w1.weight": ones(5, 8)}), "must have"),
    "no channels": (lambda e: e.update(W_hidden=ones(1, 8)), "must have the"),
}
BAD_STACKS = {
    "fewer rules": (lambda e: e.update({"w2.bias": ones(1, 8)}), "w2.bias must have as many ru"),
    "a huge stack": (
        lambda e: e["w1.weight"]["shape"].__setitem__(0, 10**9),
        "or be a stack of rules whose",
    ),
}


def changed(make):
    """Return a function that writes a file of the authors whose content is changed first."""

    def write_changed(path, change):
        content = make()
        change(content)
        if path.suffix == ".pth":
            torch.save(content, path)
        else:
            write_json(path, content if path.stem == "stack" else {"mine": content})

    return write_changed


def equivariant_demo():
    return equivariant_tensors(equivariant_state())


FORMATS = {
    "rule.safetensors": (write_ours, BAD_HEADERS),
    "npa.pth": (changed(lambda: authors_state(NPARule())), BAD_STATES),
    "equivariant.pth": (
        changed(equivariant_state),
        {"a missing key": (lambda s: s.pop("model.W_out"), r"missing: \['model.W_out'\]")},
    ),
    "models.json": (changed(lambda: demo_entry(demo_tensors(NPARule()))), BAD_ENTRIES),
    "equivariant.json": (changed(lambda: demo_entry(equivariant_demo())), BAD_EQUIVARIANT),
    "stack.json#1": (changed(lambda: demo_stack([equivariant_demo()] * 2)), BAD_STACKS),
}
"""How a changed file is written and the changes that are refused; #1: a stack's second rule."""


def unchanged(*content):
    pass


@pytest.mark.parametrize(
    ("name", "case"), [(name, case) for name, (_, cases) in FORMATS.items() for case in cases]
)
def test_a_wrong_file_is_refused(tmp_path, name, case):
    write, cases = FORMATS[name]
    change, message = cases[case]
    path = tmp_path / name.partition("#")[0]
    write(path, unchanged)
    load_rule(f"{tmp_path / name}")
    write(path, change)
    refused(f"cannot load a rule from .*: .*{message}", load_rule, f"{tmp_path / name}")


@pytest.mark.parametrize("suffix", ["safetensors", "pth", "pt", "json"])
@pytest.mark.parametrize(
    "data", [b"", b"\x00" * 64, b"garbage " * 100, b"[1, 2]", b"{}", b'{"a": 1}', b"PK\x03\x04"]
)
def test_garbage_is_refused(tmp_path, suffix, data):
    path = tmp_path / f"rule.{suffix}"
    path.write_bytes(data)
    refused("cannot load a rule from", load_rule, path)


@pytest.mark.parametrize("name", FORMATS)
def test_truncated_files_are_refused(tmp_path, name):
    write, _ = FORMATS[name]
    path = tmp_path / name.partition("#")[0]
    write(path, unchanged)
    data = path.read_bytes()
    for part in (0.01, 0.3, 0.9, 0.999):
        path.write_bytes(data[: int(part * len(data))])
        refused("cannot load a rule from", load_rule, f"{tmp_path / name}")


def test_a_printed_rule_begins_with_what_calls_need():
    first = repr(NPARule(state_dim=8, eps0=0.2)).split("\n")[1]
    assert first == "  state_dim=8, eps0=0.2, alpha=0.5"


def test_missing_files_and_folders_are_named(tmp_path, monkeypatch):
    (tmp_path / "rule.bin").touch()
    known = r"must end in \.safetensors, \.pth, \.pt, \.json"
    refused(f"{known}.*rule.bin': give the file of a rule", load_rule, tmp_path / "rule.bin")
    (tmp_path / "house.png").touch()
    train = r"house.png': npa-envs train morphogenesis2d --target '.*/house.png' trains a rule"
    refused(f"{known}.*{train}", load_rule, tmp_path / "house.png")
    (tmp_path / "broken.pth").write_bytes(b"e")
    refused("truncated one: download or copy it again", load_rule, tmp_path / "broken.pth")
    for suffix in ("safetensors", "pth", "json"):
        path = tmp_path / f"rule.{suffix}"
        refused(f"rule from '[^']*rule.{suffix}': it does not exist: check", load_rule, path)
        path.mkdir()
        refused(f"rule.{suffix}", load_rule, path)
    monkeypatch.chdir(tmp_path)
    refused("'runs/fish': it does not exist: check the path", load_rule, "runs/fish")
    (tmp_path / "runs/fish").mkdir(parents=True)
    (tmp_path / "runs/fish/rule.safetensors").touch()
    refused("unknown rule 'fish': did you mean the run 'runs/fish'", load_rule, "fish")


@pytest.mark.parametrize(
    ("source", "message"),
    [
        *((s, r"path of a file that ends in \.safet") for s in ("", "x" * 5000, Path("x" * 5000))),
        *((s, "source must be a rule's name or the path .* for ex") for s in (5, 10**5000, None)),
    ],
    ids=range(6),
)
def test_what_is_neither_name_nor_path_is_refused(source, message):
    with pytest.raises(NPAError, match=message) as caught:
        load_rule(source)
    assert len(str(caught.value)) < 400 + len(", ".join(shipped_rules()))


def test_a_rule_is_loaded_on_to_a_device_that_is_there():
    refused("device must", load_rule, "gecko", device="cuda:99")
    assert load_rule("gecko", device=torch.device("cpu")).hidden.weight.device.type == "cpu"


def test_the_authors_collection_is_written_as_they_wrote_it(reference, tmp_path):
    theirs = reference / "authors_demo_aubergine.json"
    save_demo_json({"aubergine": load_rule(theirs)}, tmp_path / "models.json")
    assert (tmp_path / "models.json").read_text(encoding="utf-8") == theirs.read_text(
        encoding="utf-8"
    )


@pytest.mark.parametrize("channels", [3, 16])
def test_a_collection_gives_each_of_its_rules_back(tmp_path, channels):
    rules = {"mine": NPARule(2, channels, 7, eps0=0.12, alpha=0.3), "gecko": load_rule("gecko-v0")}
    path = tmp_path / "models.json"
    save_demo_json(rules, path, particle_counts={"mine": 1000})
    for name, rule in rules.items():
        assert_same_rule(load_rule(f"{path}#{name}"), rule)
    entries = json.loads(path.read_text(encoding="utf-8"))
    assert {name: entry["N0"] for name, entry in entries.items()} == {"mine": 1000, "gecko": 4096}


MINE = {"mine": NPARule()}


@pytest.mark.parametrize(
    ("rules", "name", "message"),
    [
        ({"mine": NPARule(3)}, "models.json", "space_dim=2 only, 'mine' has 3"),
        ({"mine": NPARule(2, 4, 8, static=True)}, "models.json", "static=False only"),
        ({"mine": NPARule(moment_inverse="smooth")}, "models.json", "moment_inverse='threshold' o"),
        ({"mine": NPARule(species_count=2)}, "models.json", "species_count=0 only"),
        ({"mine": NPARule(equivariant=True)}, "models.json", "equivariant=False only"),
        ({"mine": NPARule(divides=True)}, "models.json", "divides=False only"),
        ({"mine": NPARule(dead_zone=0.001)}, "models.json", "dead_zone=0.0 only"),
        (MINE, "models.txt", r"must end in \.json"),
        ({}, "models.json", "at least one rule"),
    ],
)
def test_a_collection_refuses_what_the_demo_would_run_otherwise(tmp_path, rules, name, message):
    refused(message, save_demo_json, rules, tmp_path / name)
    assert not any(tmp_path.iterdir())
