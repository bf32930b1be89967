"""Files of rules in the formats of the paper's authors.

State dict (`npa.pth`): `model.0.weight` [H, P], `model.0.bias` [H], `model.2.weight` [A, H] with
rows [δ (D); Δs (C)], `eps0`, `alpha`, and for rules with a read-out `decoder.0.*`, `decoder.2.*`.
Web demo (`models.json`): for each name `w1.weight` [H, P], `w1.bias`, `w2.weight.T` [H, A] with
columns [Δs (C), δ (2)], both padded with zeros to a multiple of four columns; float32 in base64;
`eps0`, `alpha`, and `N0`, the demo's number of particles. `save_demo_json` writes it.

Equivariant rules (`equivariant_demo/`) hold `W_hidden` [C+1, V], `W_out` [V, 1], `w1.weight` [H, I]
with columns [s; smoothed s; u_a · u_b, a <= b], `w1.bias`, `w2.weight` [C+V, H] with rows [Δs; g],
`w2.bias`; in the web demo each number of the first two is repeated four times. A state dict
calls them `model.W_hidden`, `model.W_out`, `model.mlp.0.*` and `model.mlp.2.*`. `NPARule` has no
output bias: an additional hidden unit whose value is always 1 replaces it.

Stacks (`models_digits.json`) hold several rules without names: each tensor has one more dimension
at the front, and `eps0`, `N0` and `alpha` are common to all.
"""

from __future__ import annotations

import base64
import binascii
import inspect
import io
import json
import math
import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from npa_envs.atomic_files import check_torch_archive, checked_path, parse_json, write_text
from npa_envs.checks import check_dense, checked_finite
from npa_envs.errors import NPAError, check_known, shown
from npa_envs.rule.rule import NPARule, check_rule

_DEMO_SPACE_DIM = 2
_DEMO_FREE = {"state_dim", "hidden_dim", "eps0", "alpha", "readout_hidden_dim", "mixed_vectors"}
"""Hyper-parameters in the web demo's files; all others must be the defaults of `NPARule`."""

DEMO_PARTICLE_COUNT = 4096
"""Default number of particles in the web demo."""

MAX_STACKED = 4096
"""Largest number of rules in a stack."""

_TEXEL = 4
"""Rows of the web demo's weights, stored as RGBA textures, are padded to a multiple of this."""

ZIP_MARK = b"PK\x03\x04"
"""First bytes of a file of torch.save in its zip format, which has checksums."""

_EQUIVARIANT_NAMES = {
    "model.W_hidden": "W_hidden", "model.W_out": "W_out",
    "model.mlp.0.weight": "w1.weight", "model.mlp.0.bias": "w1.bias",
    "model.mlp.2.weight": "w2.weight", "model.mlp.2.bias": "w2.bias",
}  # fmt: skip
"""Names of an equivariant rule's tensors: in a state dict -> in the web demo."""

_WEIGHT_NAMES = {
    "model.0.weight": "hidden.weight", "model.0.bias": "hidden.bias",
    "model.2.weight": "output.weight",
    "decoder.0.weight": "readout.0.weight", "decoder.0.bias": "readout.0.bias",
    "decoder.2.weight": "readout.2.weight", "decoder.2.bias": "readout.2.bias",
}  # fmt: skip
"""Names of another rule's tensors: in a state dict -> in `NPARule`."""
_DECODER_NAMES = {name for name in _WEIGHT_NAMES if name.startswith("decoder")}
_IGNORED = {"N0"}


@dataclass(frozen=True)
class RuleParts:
    """An `NPARule` as read from a file: the arguments of its constructor, and its state dict."""

    hyper_parameters: dict[str, Any]
    weights: dict[str, Tensor]


def check_weights(weights: Mapping[str, Tensor]) -> None:
    """Check that all weights are finite, and all float32 or all float64."""
    dtypes = {tensor.dtype for tensor in weights.values()}
    if len(dtypes) != 1 or not dtypes <= {torch.float32, torch.float64}:
        raise NPAError(
            "the weights must be all float32 or all float64, got "
            f"{sorted(str(dtype) for dtype in dtypes)}: convert them, as rule.float() does, and "
            "save the rule again"
        )
    for name, tensor in weights.items():
        bad = int((~torch.isfinite(tensor)).sum())
        if bad:
            raise NPAError(
                f"the weights must be finite, got {bad} of {tensor.numel()} numbers in "
                f"{shown(name)} NaN or infinite: take an earlier checkpoint, or train with a lower "
                "learning rate"
            )


def read_state_dict(data: bytes) -> RuleParts:
    """Return the rule in a file of the authors' state dict; shapes of its tensors give D and C."""
    state = _unpickle(data)
    known, rule_type, more = _WEIGHT_NAMES, "", f" and, with a read-out, {sorted(_DECODER_NAMES)}"
    if state.keys() & _EQUIVARIANT_NAMES:
        known, rule_type, more = _EQUIVARIANT_NAMES, " of an equivariant rule", ""
    decoder = _DECODER_NAMES & known.keys()
    required = {*known, "eps0", "alpha"} - decoder
    if {"hidden.weight", "output.weight"} <= state.keys():
        raise NPAError(
            "this is the state dict of an NPARule, which lacks hyper-parameters such as eps0: save "
            "the rule with npa_envs.save_rule(rule, 'rule.safetensors'); if there is only this "
            "file, give a new NPARule with the same hyper-parameters its load_state_dict first"
        )
    missing = required - state.keys()
    missing |= decoder - state.keys() if state.keys() & decoder else set()
    unknown = state.keys() - required - decoder - _IGNORED
    if missing or unknown:
        raise NPAError(
            f"the state dict{rule_type} must hold {sorted(required)}{more}; missing: "
            f"{sorted(missing)}, unknown: {shown(sorted(map(str, unknown)))}: a file of another "
            "model holds no rule; give the npa.pth of the authors' training, or a run's folder"
        )
    weights = {known[name]: _matrix(name, state[name]) for name in known if name in state}
    if known is _EQUIVARIANT_NAMES:
        return _equivariant_parts(weights, state)
    perception_dim, update_dim = weights["hidden.weight"].shape[1], len(weights["output.weight"])
    has_readout = "readout.0.weight" in weights
    channels = weights["readout.0.weight"].shape[1] if has_readout else None
    space_dim, state_dim, static = _infer_dimensions(perception_dim, update_dim, channels)
    sizes: dict[str, Any] = {"space_dim": space_dim, "state_dim": state_dim, "static": static}
    if has_readout:
        sizes["readout_hidden_dim"] = weights["readout.0.weight"].shape[0]
        sizes["readout_dim"] = weights["readout.2.weight"].shape[0]
    return _rule_parts(weights, state, **sizes)


def _rule_parts(
    weights: dict[str, Tensor], scalars: Mapping[Any, Any], **hyper_parameters: Any
) -> RuleParts:
    """Return the `RuleParts` of weights, hyper-parameters, and `eps0` and `alpha` in `scalars`.

    Without `space_dim` the rule is a 2D one.
    """
    common = {name: _scalar(name, scalars.get(name)) for name in ("eps0", "alpha")}
    sizes = {"space_dim": _DEMO_SPACE_DIM, "hidden_dim": len(weights["hidden.weight"])}
    return RuleParts(sizes | common | hyper_parameters, weights)


def _equivariant_parts(
    tensors: Mapping[str, Tensor], scalars: Mapping[Any, Any], *, padded: bool = False
) -> RuleParts:
    """Return `RuleParts` of a 2D equivariant rule from tensors with the names of `models.json`.

    `scalars` has `eps0` and `alpha`. `padded` tensors end in zeros, which are cut off.
    """
    mixing = tensors["W_hidden"]
    state_dim, mixed = mixing.shape[0] - 1, mixing.shape[1]
    hidden_dim = len(tensors["w1.weight"])
    input_dim = 2 * state_dim + mixed * (mixed + 1) // 2
    output_dim = state_dim + mixed
    wanted = {
        "W_out": (mixed, 1),
        "w1.weight": (hidden_dim, input_dim),
        "w1.bias": (hidden_dim,),
        "w2.weight": (output_dim, hidden_dim),
        "w2.bias": (output_dim,),
    }
    if padded:
        tensors = {name: tensors[name][tuple(map(slice, wanted[name]))] for name in wanted}
    first, second = tensors["w1.weight"], tensors["w2.weight"]
    got = {name: tuple(tensors[name].shape) for name in wanted}
    if state_dim < 1 or got != wanted:
        raise NPAError(
            f"an equivariant rule with W_hidden {tuple(mixing.shape)}, [C+1, V], must have the "
            f"shapes {wanted}, got {got}"
        )
    # The additional hidden unit is always 1: its output weights are the bias.
    with_bias = torch.cat((second, tensors["w2.bias"][:, None]), dim=1)
    weights = {
        "hidden.weight": torch.cat((first, first.new_zeros(1, input_dim))),
        "hidden.bias": torch.cat((tensors["w1.bias"], first.new_ones(1))),
        "output.weight": torch.cat((with_bias[state_dim:], with_bias[:state_dim])),
        "mixing": mixing.contiguous(),
        "steering": tensors["W_out"][:, 0].contiguous(),
    }
    return _rule_parts(weights, scalars, state_dim=state_dim, equivariant=True, mixed_vectors=mixed)


def read_demo_json(data: bytes, name: str | None) -> RuleParts:
    """Return the rule `name` in a JSON file of the authors' web demo; None: its only rule."""
    entry, index = _demo_rule(parse_json(data), name)
    if "W_hidden" not in entry:
        return _plain_demo_parts(entry, index)
    tensors = {
        known: _decoded_tensor(entry, known, 1 if known.endswith("bias") else 2, index)
        for known in _EQUIVARIANT_NAMES.values()
    }
    # Each number is repeated.
    tensors |= {known: tensors[known][:, ::_TEXEL] for known in ("W_hidden", "W_out")}
    return _equivariant_parts(tensors, entry, padded=True)


def _plain_demo_parts(entry: Mapping[str, Any], index: int | None) -> RuleParts:
    """Return `RuleParts` of a rule that is not equivariant; `index` is its place in a stack."""
    first = _decoded_tensor(entry, "w1.weight", 2, index)
    bias = _decoded_tensor(entry, "w1.bias", 1, index)
    second = _decoded_tensor(entry, "w2.weight.T", 2, index)
    hidden_dim, padded = first.shape
    state_dim = padded // _TEXEL - 1
    update_dim = state_dim + _DEMO_SPACE_DIM
    padded_update = _TEXEL * math.ceil(update_dim / _TEXEL)
    if state_dim < 1 or second.shape != (hidden_dim, padded_update) or bias.shape[0] < hidden_dim:
        raise NPAError(
            "w1.weight [H, 4C+4], w1.bias [H] and w2.weight.T [H, C+2 padded to a multiple of 4] "
            f"must agree, got {tuple(first.shape)}, {tuple(bias.shape)}, {tuple(second.shape)}"
        )
    perception_dim = state_dim * (2 + _DEMO_SPACE_DIM) + _DEMO_SPACE_DIM
    state_rows = second[:, :state_dim].T
    displacement_rows = second[:, state_dim:update_dim].T
    weights = {
        "hidden.weight": first[:, :perception_dim].clone(),
        "hidden.bias": bias[:hidden_dim].clone(),
        "output.weight": torch.cat([displacement_rows, state_rows]).contiguous(),
    }
    return _rule_parts(weights, entry, state_dim=state_dim)


def _demo_rule(content: Any, name: str | None) -> tuple[Mapping[str, Any], int | None]:
    """Return the JSON object with the rule `name`, and the rule's index there if it is a stack.

    The rules of a stack are called "0", "1", ...; a single rule has the index None.
    """
    rules: dict[str, tuple[Mapping[str, Any], int | None]] = {}
    if isinstance(content, dict) and isinstance(content.get("w1.weight"), dict):
        shape = content["w1.weight"].get("shape")
        if isinstance(shape, list) and len(shape) == 3 and shape[0] in range(1, MAX_STACKED + 1):
            rules = {str(k): (content, k) for k in range(shape[0])}
    elif isinstance(content, dict) and all(isinstance(entry, dict) for entry in content.values()):
        rules = {known: (content[known], None) for known in sorted(content)}
    if not rules:
        raise NPAError(
            "the JSON file must map names to rules, or be a stack of rules whose w1.weight has "
            "shape [rules, H, inputs], as the authors' web demo has them"
        )
    if name is None and len(rules) > 1:
        raise NPAError(
            f"the file holds several rules: add #name; names: {shown(', '.join(rules))[1:-1]}"
        )
    name = next(iter(rules)) if name is None else name
    check_known("the file holds no rule", name, rules)
    return rules[name]


def save_demo_json(
    rules: Mapping[str, NPARule],
    path: str | Path,
    *,
    particle_counts: Mapping[str, int] | None = None,
) -> None:
    """Write rules, by name, to one JSON file that the authors' web demo reads, in float32.

    `particle_counts` are those of the demo's worlds, by default `DEMO_PARTICLE_COUNT` each.
    `load_rule("models.json#name")` reads each rule.
    """
    path = checked_path(path)
    if path.suffix != ".json":
        raise NPAError(
            f"a collection of the authors' demo must end in .json, got {shown(str(path))}: "
            f"use {shown(str(path.with_suffix('.json')))}"
        )
    if not isinstance(rules, Mapping) or not rules:
        raise NPAError(f"rules must map names to at least one rule, got {shown(rules)}")
    counts = particle_counts or {}
    entries = {
        str(name): _demo_entry(name, rule, counts.get(name, DEMO_PARTICLE_COUNT))
        for name, rule in rules.items()
    }
    write_text(path, json.dumps(entries))


def _demo_entry(name: str, rule: NPARule, particle_count: int) -> dict[str, Any]:
    check_rule(rule)
    defaults = inspect.signature(NPARule).parameters
    for field, value in rule.hyper_parameters().items():
        default = defaults[field].default
        if field not in _DEMO_FREE and value != default:
            raise NPAError(
                f"the authors' demo runs rules with {field}={default!r} only, {shown(name)} has "
                f"{value!r}: save it with npa_envs.save_rule"
            )
    if not rule.is_plain():
        raise NPAError(
            f"the authors' demo runs rules of two plain layers only, {shown(name)} is a "
            f"{type(rule).__name__} with another network"
        )
    weights = {k: v.detach().cpu().float() for k, v in rule.state_dict().items()}
    check_weights(weights)
    displacement, states = weights["output.weight"].split([rule.space_dim, rule.state_dim])
    return {
        "eps0": _as_float32(rule.eps0),
        "N0": particle_count,
        "alpha": _as_float32(rule.alpha),
        "w1.weight": _encoded_tensor(_texels(weights["hidden.weight"])),
        "w1.bias": _encoded_tensor(weights["hidden.bias"]),
        "w2.weight.T": _encoded_tensor(_texels(torch.cat([states, displacement]).T)),
    }


def _texels(matrix: Tensor) -> Tensor:
    """Return a matrix with columns of zeros added, up to a multiple of `_TEXEL`."""
    return torch.nn.functional.pad(matrix, (0, -matrix.shape[1] % _TEXEL))


def _encoded_tensor(tensor: Tensor) -> dict[str, Any]:
    data = base64.b64encode(tensor.contiguous().numpy().astype("<f4").tobytes()).decode()
    return {"shape": list(tensor.shape), "dtype": "float32", "data64": data}


def _unpickle(data: bytes) -> Mapping[Any, Any]:
    is_zip = data.startswith(ZIP_MARK)
    if is_zip:
        check_torch_archive(io.BytesIO(data))
    try:
        state = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        doubt = "" if is_zip else "is no state dict, is damaged, or "
        raise NPAError(
            f"the file {doubt}holds objects other than tensors, which could run code: "
            "export a model of the authors with torch.save(model.state_dict(), path), and save a "
            "rule of this package with npa_envs.save_rule"
        ) from error
    except Exception as error:
        # Torch raises exceptions of many kinds for damaged data.
        raise NPAError(
            "this is no state dict of tensors that torch reads without running code, or a "
            "truncated one: download or copy it again"
        ) from error
    if not isinstance(state, Mapping):
        raise NPAError(f"the file must hold a state dict, got a {type(state).__name__}")
    return state


def _check_not_expanded(name: str, tensor: Tensor) -> None:
    check_dense(name, tensor)
    stored = tensor.untyped_storage().nbytes()
    if tensor.numel() * tensor.element_size() > stored:
        raise NPAError(
            f"{name} must hold all its numbers, got shape {shown(tuple(tensor.shape))} of {stored} "
            "bytes: export the state dict with tensors that are not expanded"
        )


def _matrix(name: str, value: Any) -> Tensor:
    """Return the weight or bias `name`, checked; the weight of a 1x1 convolution as a matrix."""
    rank = 1 if name.endswith("bias") else 2
    if not isinstance(value, Tensor):
        raise NPAError(f"{name} must be a tensor, got a {type(value).__name__}")
    _check_not_expanded(name, value)
    if value.ndim == 4 and rank == 2 and value.shape[2:] == (1, 1):
        value = value[:, :, 0, 0]
    if value.ndim != rank:
        raise NPAError(f"{name} must have {rank} dimension(s), got shape {tuple(value.shape)}")
    tensor: Tensor = value.detach().contiguous()
    return tensor


def _infer_dimensions(
    perception_dim: int, update_dim: int, channels: int | None
) -> tuple[int, int, bool]:
    """Return (D, C, static) such that P = C(2+D)+D and A = C+D, or C if static.

    `channels` is C as the read-out's shape says; None: the rule has no read-out.
    """
    fitting = []
    for space_dim in (2, 3):
        state_dim, rest = divmod(perception_dim - space_dim, 2 + space_dim)
        if rest or state_dim < 1 or channels not in (None, state_dim):
            continue
        if update_dim in (state_dim, state_dim + space_dim):
            fitting.append((space_dim, state_dim, update_dim == state_dim))
    if len(fitting) != 1:
        raise NPAError(
            "model.0.weight [H, C(2+D)+D] and model.2.weight [C+D or C, H] must fit one space "
            f"dimension D of 2 or 3, got {perception_dim} inputs and {update_dim} outputs, which "
            f"fit {len(fitting)}"
        )
    return fitting[0]


def _scalar(name: str, value: Any) -> float:
    """Return the shortest decimal number that rounds to the float32 `value`, such as 0.1."""
    if isinstance(value, Tensor):
        _check_not_expanded(name, value)
    number = checked_finite(name, value)
    for digits in range(1, 10):
        rounded = float(f"{number:.{digits}g}")
        if _as_float32(rounded) == number:
            return rounded
    return number


def _as_float32(number: float) -> float:
    return torch.tensor(number, dtype=torch.float32).item()


def _decoded_tensor(entry: Mapping[str, Any], name: str, rank: int, index: int | None) -> Tensor:
    """Return the tensor `name`, of `rank` dimensions, of a rule in the authors' JSON.

    `index` is the rule's place in a stack; None: the rule stands by itself.
    """
    stacked = index is not None
    rank += stacked
    packed = entry.get(name)
    if not isinstance(packed, dict) or not {"shape", "dtype", "data64"} <= packed.keys():
        raise NPAError(f"the rule lacks {name!r} with its shape, dtype and data64")
    shape, dtype = packed["shape"], packed["dtype"]
    sizes_fit = isinstance(shape, list) and all(type(n) is int and n > 0 for n in shape)
    if dtype != "float32" or not sizes_fit or len(shape) != rank:
        raise NPAError(
            f"{name} must be float32 with {rank} dimension(s), got {shown(dtype)} {shown(shape)}"
        )
    try:
        data = base64.b64decode(packed["data64"], validate=True)
    except (binascii.Error, TypeError, ValueError) as error:
        raise NPAError(f"the data of {name} is no base64 text ({shown(error)})") from error
    if len(data) != 4 * math.prod(shape):
        raise NPAError(
            f"the data of {name} must be {4 * math.prod(shape)} bytes for shape "
            f"{shown(shape)}, got {len(data)}: the file is damaged"
        )
    tensor = torch.frombuffer(bytearray(data), dtype=torch.float32).reshape(shape)
    if index is None:
        return tensor
    if index >= shape[0]:
        raise NPAError(f"{name} must have as many rules as w1.weight, got {shape[0]}")
    return tensor[index].clone()
