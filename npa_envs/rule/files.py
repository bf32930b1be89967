"""Files of rules: ours (safetensors), and the two formats of the paper's authors.

Ours holds the weights under `NPARule`'s own names and, in the header's metadata, the format's name
and version, every hyper-parameter and a checksum, so that a file is all that is needed to run a
rule. The checksum is SHA-256 over all else that the file says; older files have none.

State dict (`npa.pth`): `model.0.weight` [H, P], `model.0.bias` [H], `model.2.weight` [A, H] with
rows [δ (D); Δs (C)], `eps0`, `alpha`, and for rules with a read-out `decoder.0.*`, `decoder.2.*`.
Web demo (`models.json`): for each name `w1.weight` [H, P], `w1.bias`, `w2.weight.T` [H, A] with
columns [Δs (C), δ (2)], both padded with zeros to a multiple of four columns; float32 in base64;
`eps0`, `alpha`, and `N0`, with how many particles the demo starts. `save_demo_json` writes it.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import io
import json
import math
import os
import pickle
import struct
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_origin, get_type_hints

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as serialise
from torch import Tensor

from npa_envs.devices import check_device
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.files import (
    check_regular,
    check_torch_archive,
    checked_path,
    parse_json,
    read_bytes,
    write_bytes,
    write_text,
)
from npa_envs.rule.rule import NPARule, RuleHyperParameters, check_rule

FORMAT_NAME = "npa-envs rule"
FORMAT_VERSION = 1
_FIELDS = {
    name: str if get_origin(kind) is Literal else kind
    for name, kind in get_type_hints(RuleHyperParameters).items()
}
_RESERVED = {"format", "version", "checksum", *_FIELDS}
_SUFFIXES = (".safetensors", ".pth", ".pt", ".json")
_LARGEST_FILE = 64 * 2**20
"""Bytes that a rule's file has at most; the largest rule that is shipped has 0.1 MiB."""


@dataclass(frozen=True)
class RuleParts:
    """A rule taken apart: what `NPARule` is made with, and its weights by its own names."""

    hyper_parameters: dict[str, Any]
    weights: dict[str, Tensor]
    header: dict[str, str] | None = None
    """Metadata of a file in our format."""
    has_checksum: bool = False
    """Whether the file has one, by which damage of it is told."""


def shipped_rules(task: str | None = None) -> dict[str, Path]:
    """Return the rules that come with the package: name -> file, sorted by name.

    Args:
        task: Only those that were trained on this task, for example "morphogenesis2d".

    Raises:
        NPAError: The task is no text.
    """
    folder = Path(__file__).resolve().parent / "shipped"
    rules = {path.stem: path for path in sorted(folder.glob("*.safetensors"))}
    if not isinstance(task, str | None):
        raise NPAError(f"task must be the name of one, got {shown(task)}: for example 'texture'")
    if task is None:
        return rules
    return {name: path for name, path in rules.items() if rule_metadata(path).get("task") == task}


def first_rules() -> dict[str, Path]:
    """Return the rules that runs of presets begin with: name -> file, sorted by name.

    They have learned one picture in small worlds, and are not shipped to be looked at.
    """
    folder = Path(__file__).resolve().parent / "first"
    return {path.stem: path for path in sorted(folder.glob("*.safetensors"))}


def load_rule(source: str | Path, *, device: str | torch.device = "cpu") -> NPARule:
    """Load a rule: a shipped one by name, or a file in our format or one of the authors'.

    Args:
        source: The name of a rule (`shipped_rules()`, `first_rules()`), or the path of a
            `.safetensors` file that `save_rule` wrote, of the authors' state dict (`.pth`, `.pt`;
            no code in it is run), or of their web demo's collection: `"models.json#name"`.
        device: Where the weights go: "cpu", "cuda", "cuda:1", or torch's own device.

    Returns:
        The rule, its weights in the precision of the file (float32 or float64). Torch's random
        state is left alone. A file without a checksum is loaded with a `UserWarning`, as damage
        cannot be told there: a `.safetensors` file of an older version, the authors' `.json`, and
        a state dict that torch before 1.6 wrote, or that was saved in its format.

    Raises:
        NPAError: The name is unknown, the file is missing, garbage, truncated, of an unknown
            version, does not hold a rule, holds weights that are not finite, or has changed since
            it was written; or there is no such device.
    """
    target = check_device(device)
    path, name = _locate(source)
    try:
        if path.suffix == ".safetensors":
            parts = _read_ours(path)
        elif path.suffix == ".json":
            parts = read_demo_json(read_bytes(path, limit=_LARGEST_FILE), name)
        else:
            parts = read_state_dict(read_bytes(path, limit=_LARGEST_FILE))
        rule = _assemble(parts)
        if parts.header is not None:
            _verify(parts.header, parts.weights)
    except NPAError as error:
        raise NPAError(f"cannot load a rule from {shown(str(source))}: {error}") from error
    if not parts.has_checksum:
        warnings.warn(
            f"the rule's file {shown(str(path))} has no checksum, so that damage cannot be told: "
            "if it is known to be good, save it again with npa_envs.save_rule",
            stacklevel=2,
        )
    return rule.to(target)


def save_rule(
    rule: NPARule, path: str | Path, *, metadata: Mapping[str, str] | None = None
) -> None:
    """Write a rule with all its hyper-parameters to a `.safetensors` file, whole or not at all.

    The same rule and metadata give the same bytes.

    Args:
        rule: The rule; its weights are written in their own precision.
        path: The file to write, ending in `.safetensors`; an existing one is replaced.
        metadata: More text for the header, for example how the rule was trained.

    Raises:
        NPAError: The suffix is another one, the metadata is not text or takes a reserved name, a
            weight is not finite, or the file cannot be written.
    """
    check_rule(rule)
    path = checked_path(path)
    if path.suffix != ".safetensors":
        raise NPAError(
            f"a rule's file must end in .safetensors, got {shown(str(path))}: "
            f"use {shown(str(path.with_suffix('.safetensors')))}"
        )
    header = {"format": FORMAT_NAME, "version": str(FORMAT_VERSION)}
    header |= {name: json.dumps(value) for name, value in rule.hyper_parameters().items()}
    if not isinstance(metadata, Mapping | None):
        raise NPAError(
            f"metadata must map text to text, got {type(metadata).__name__}: for example "
            "metadata={'trained by': 'me'}"
        )
    for name, text in (metadata or {}).items():
        if not isinstance(name, str) or not isinstance(text, str):
            raise NPAError(
                f"metadata must map text to text, got {shown(name)}: {shown(text)}: use str()"
            )
        if name in _RESERVED:
            raise NPAError(
                f"metadata must not use the name {shown(name)}: the format holds it itself"
            )
        header[name] = text
    weights = {k: v.detach().cpu().contiguous() for k, v in rule.state_dict().items()}
    _check_finite(weights)
    header["checksum"] = _checksum(header, weights)
    write_bytes(path, _with_sorted_metadata(serialise(weights, metadata=header)))


def _with_sorted_metadata(file: bytes) -> bytes:
    """Return a safetensors file whose metadata is in order, so that equal rules make equal files.

    The library writes it in an order that changes from call to call.
    """
    size = int.from_bytes(file[:8], "little")
    header = json.loads(file[8 : 8 + size])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    # The format asks for tensors that begin at a multiple of 8 bytes, after spaces.
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + file[8 + size :]


def rule_metadata(path: str | Path) -> dict[str, str]:
    """Return the text in the header of a file that `save_rule` wrote, all of it.

    Args:
        path: The `.safetensors` file.

    Raises:
        NPAError: The file is missing, garbage, truncated, or not a rule.
    """
    try:
        return _read_header(checked_path(path))
    except NPAError as error:
        raise NPAError(f"cannot read the header of {shown(str(path))}: {error}") from error


def _locate(source: str | Path) -> tuple[Path, str | None]:
    """Find the file that `source` means, and the name after '#'."""
    if not isinstance(source, str | os.PathLike):
        raise NPAError(
            f"source must be a rule's name or the path of its file, got {shown(source)}: "
            "for example 'gecko'"
        )
    text = str(source)
    known = shipped_rules()
    suffixes = ", ".join(_SUFFIXES)
    if not text:
        raise NPAError(
            "source must be the name of a shipped rule or the path of a file that ends in "
            f"{suffixes}, got '': names: {', '.join(known)}"
        )
    named = known | first_rules()
    if text in named:
        return named[text], None
    base, mark, name = text.rpartition("#")
    path, inner = (Path(base), name) if mark and base.endswith(".json") else (Path(text), None)
    if path.suffix in _SUFFIXES:
        return path, inner
    if os.path.exists(path):
        raise NPAError(f"a rule's file must end in {suffixes}, got {shown(text)}: rename it")
    raise NPAError(
        f"unknown rule {shown(text)}: {suggest(text, known)}; or give the path of a "
        f"file that ends in {suffixes}"
    )


def _read_header(path: Path) -> dict[str, str]:
    check_regular(path, limit=_LARGEST_FILE)
    try:
        with safe_open(path, framework="pt") as file:
            header: dict[str, str] = file.metadata() or {}
    except (OSError, ValueError, SafetensorError) as error:
        raise NPAError(
            f"this is no safetensors file, or a truncated one ({shown(error)})"
        ) from error
    if header.get("format") != FORMAT_NAME:
        raise NPAError(
            f"the metadata's format must be {FORMAT_NAME!r}, got {shown(header.get('format'))}: "
            "this safetensors file was not written by npa_envs.save_rule"
        )
    if header.get("version") != str(FORMAT_VERSION):
        raise NPAError(
            f"the metadata's version must be {FORMAT_VERSION}, got {shown(header.get('version'))}: "
            "upgrade with pip install -U npa-envs"
        )
    return header


def _read_ours(path: Path) -> RuleParts:
    header = _read_header(path)
    hyper_parameters = {
        name: _parse(header, name, kind)
        for name, kind in _FIELDS.items()
        if name in header or name in RuleHyperParameters.__required_keys__
    }
    try:
        with safe_open(path, framework="pt") as file:
            weights = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise NPAError(f"the weights cannot be read ({shown(error)})") from error
    return RuleParts(hyper_parameters, weights, header, has_checksum="checksum" in header)


def _checksum(header: Mapping[str, str], weights: Mapping[str, Tensor]) -> str:
    """Return SHA-256 over the metadata, but for the checksum itself, and over all weights."""
    told: list[Any] = sorted(item for item in header.items() if item[0] != "checksum")
    told += [(name, str(tensor.dtype), *tensor.shape) for name, tensor in sorted(weights.items())]
    found = hashlib.sha256(json.dumps(told).encode())
    for _, tensor in sorted(weights.items()):
        found.update(tensor.numpy().tobytes())
    return found.hexdigest()


def _verify(header: Mapping[str, str], weights: Mapping[str, Tensor]) -> None:
    """Check that a file is as it was written, where it says what that was."""
    if header.get("checksum", found := _checksum(header, weights)) != found:
        raise NPAError(
            "the checksum must be that of the weights and of the metadata, got another one: the "
            "file is damaged, or another program has changed it; copy it again from where it came"
        )


def _parse(header: Mapping[str, str], name: str, kind: type) -> Any:
    if name not in header:
        raise NPAError(f"the metadata lacks {name!r}: save the rule again with npa_envs.save_rule")
    try:
        value = parse_json(header[name])
        if kind is float and type(value) is int:
            value = float(value)
    except (NPAError, OverflowError):
        value = None
    if type(value) is not kind:
        raise NPAError(
            f"the metadata's {name!r} must be a JSON {kind.__name__}, got {shown(header[name])}"
        )
    return value


def _assemble(parts: RuleParts) -> NPARule:
    """Build the rule without drawing initial weights: shapes first, then the tensors themselves."""
    try:
        with torch.device("meta"):
            rule = NPARule(**parts.hyper_parameters)
    except (RuntimeError, TypeError, OverflowError) as error:
        raise NPAError(
            f"no rule has the hyper-parameters {shown(parts.hyper_parameters)}"
        ) from error
    expected = {name: tuple(tensor.shape) for name, tensor in rule.state_dict().items()}
    got = {name: tuple(tensor.shape) for name, tensor in parts.weights.items()}
    if got != expected:
        wrong = sorted(
            f"{name}: {got.get(name, 'missing')} instead of {expected.get(name, 'nothing')}"
            for name in expected.keys() | got.keys()
            if expected.get(name) != got.get(name)
        )
        raise NPAError(f"the weights must have the hyper-parameters' shapes, got {shown(wrong)}")
    dtypes = {tensor.dtype for tensor in parts.weights.values()}
    if len(dtypes) != 1 or not dtypes <= {torch.float32, torch.float64}:
        raise NPAError(
            "the weights must be all float32 or all float64, got "
            f"{sorted(str(dtype) for dtype in dtypes)}: convert them and save the rule again"
        )
    _check_finite(parts.weights)
    rule.load_state_dict(dict(parts.weights), assign=True)
    return rule.requires_grad_()


def _check_finite(weights: Mapping[str, Tensor]) -> None:
    for name, tensor in weights.items():
        bad = int((~torch.isfinite(tensor)).sum())
        if bad:
            raise NPAError(
                f"the weights must be finite, got {bad} of {tensor.numel()} numbers in "
                f"{shown(name)} NaN or infinite: take an earlier checkpoint, or train with a lower "
                "learning rate"
            )


# The formats of the paper's authors.

_DEMO_SPACE_DIM = 2
_DEMO_KIND = {
    "space_dim": _DEMO_SPACE_DIM,
    "static": False,
    "readout_dim": 0,
    "moment_correction": True,
    "moment_inverse": "threshold",
    "state_gradient": True,
    "density_gradient": True,
    "species_count": 0,
}
"""What rules of the web demo are like; its files do not say it."""

DEMO_PARTICLE_COUNT = 4096
"""Particles of a world in the web demo where nothing else is said."""

_TEXEL = 4
"""The web demo keeps its weights in RGBA textures: rows are padded to a multiple of this."""

_ZIP_MARK = b"PK\x03\x04"
"""What a file of torch.save begins with, unless it is in torch's legacy format."""

_WEIGHT_NAMES = {
    "model.0.weight": "hidden.weight",
    "model.0.bias": "hidden.bias",
    "model.2.weight": "output.weight",
    "decoder.0.weight": "readout.0.weight",
    "decoder.0.bias": "readout.0.bias",
    "decoder.2.weight": "readout.2.weight",
    "decoder.2.bias": "readout.2.bias",
}
_DECODER_NAMES = {name for name in _WEIGHT_NAMES if name.startswith("decoder")}
_IGNORED = {"N0"}


def read_state_dict(data: bytes) -> RuleParts:
    """Read the authors' state dict.

    The space dimension and the number of channels follow from the shapes.

    Raises:
        NPAError: This is not such a file.
    """
    state = _unpickle(data)
    required = {"model.0.weight", "model.0.bias", "model.2.weight", "eps0", "alpha"}
    missing = required - state.keys()
    if state.keys() & _DECODER_NAMES:
        missing |= _DECODER_NAMES - state.keys()
    unknown = state.keys() - required - _DECODER_NAMES - _IGNORED
    if missing or unknown:
        raise NPAError(
            f"the state dict must hold {sorted(required)} and, with a read-out, "
            f"{sorted(_DECODER_NAMES)}; missing: {sorted(missing)}, unknown: "
            f"{shown(sorted(map(str, unknown)))}"
        )
    weights = {}
    for theirs, ours in _WEIGHT_NAMES.items():
        if theirs in state:
            weights[ours] = _matrix(theirs, state[theirs])
    hidden_dim, perception_dim = weights["hidden.weight"].shape
    update_dim = weights["output.weight"].shape[0]
    has_readout = "readout.0.weight" in weights
    channels = weights["readout.0.weight"].shape[1] if has_readout else None
    space_dim, state_dim, static = _infer_dimensions(perception_dim, update_dim, channels)
    hyper_parameters = {
        "space_dim": space_dim,
        "state_dim": state_dim,
        "hidden_dim": hidden_dim,
        "eps0": _scalar("eps0", state["eps0"]),
        "alpha": _scalar("alpha", state["alpha"]),
        "static": static,
    }
    if has_readout:
        hyper_parameters["readout_dim"] = weights["readout.2.weight"].shape[0]
        hyper_parameters["readout_hidden_dim"] = weights["readout.0.weight"].shape[0]
    return RuleParts(hyper_parameters, weights, has_checksum=data.startswith(_ZIP_MARK))


def read_demo_json(data: bytes, name: str | None) -> RuleParts:
    """Read one rule of the authors' web demo.

    Args:
        data: The content of the JSON file.
        name: The rule's name in it; None where the file holds one only.

    Raises:
        NPAError: This is not such a file, or it has no rule of that name.
    """
    collection = parse_json(data)
    names = sorted(collection) if isinstance(collection, dict) else []
    if not names or not all(isinstance(collection[known], dict) for known in names):
        raise NPAError("the JSON file must map names to rules, as the authors' web demo has them")
    if name is None and len(names) > 1:
        raise NPAError(
            f"the file holds several rules: add #name; names: {shown(', '.join(names))[1:-1]}"
        )
    name = names[0] if name is None else name
    if name not in collection:
        raise NPAError(f"the file holds no rule {shown(name)}: {suggest(name, names)}")
    entry = collection[name]
    first = _decode(entry, "w1.weight", 2)
    bias = _decode(entry, "w1.bias", 1)
    second = _decode(entry, "w2.weight.T", 2)
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
    hyper_parameters = {
        "space_dim": _DEMO_SPACE_DIM,
        "state_dim": state_dim,
        "hidden_dim": hidden_dim,
        "eps0": _scalar("eps0", entry.get("eps0")),
        "alpha": _scalar("alpha", entry.get("alpha")),
    }
    return RuleParts(hyper_parameters, weights)


def save_demo_json(
    rules: Mapping[str, NPARule],
    path: str | Path,
    *,
    particle_counts: Mapping[str, int] | None = None,
) -> None:
    """Write rules as a collection of the authors' web demo, in float32, whole or not at all.

    `load_rule("models.json#name")` gives each of them back.

    Args:
        rules: Name -> rule; the demo has 2D rules without read-out that perceive all the paper's
            fields and nothing else.
        path: The file to write, ending in `.json`; an existing one is replaced.
        particle_counts: With how many particles a rule starts there; 4096 where nothing is said.

    Raises:
        NPAError: There are no rules, a rule is not of the demo's kind, a weight is not finite in
            float32, the suffix is another one, or the file cannot be written.
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
    made = rule.hyper_parameters()
    for field, wanted in _DEMO_KIND.items():
        if made.get(field, wanted) != wanted:
            raise NPAError(
                f"the authors' demo runs rules with {field}={wanted!r} only, {shown(name)} has "
                f"{made[field]!r}: save it with npa_envs.save_rule"  # type: ignore[literal-required]
            )
    if not rule.is_plain():
        raise NPAError(
            f"the authors' demo runs rules of two plain layers only, {shown(name)} is a "
            f"{type(rule).__name__} with a network of its own"
        )
    weights = {k: v.detach().cpu().float() for k, v in rule.state_dict().items()}
    _check_finite(weights)
    displacement, states = weights["output.weight"].split([rule.space_dim, rule.state_dim])
    return {
        "eps0": _as_float32(rule.eps0),
        "N0": particle_count,
        "alpha": _as_float32(rule.alpha),
        "w1.weight": _encode(_texels(weights["hidden.weight"])),
        "w1.bias": _encode(weights["hidden.bias"]),
        "w2.weight.T": _encode(_texels(torch.cat([states, displacement]).T)),
    }


def _texels(matrix: Tensor) -> Tensor:
    """Return a matrix padded with columns of zeros to whole texels."""
    return torch.nn.functional.pad(matrix, (0, -matrix.shape[1] % _TEXEL))


def _encode(tensor: Tensor) -> dict[str, Any]:
    data = base64.b64encode(tensor.contiguous().numpy().astype("<f4").tobytes()).decode()
    return {"shape": list(tensor.shape), "dtype": "float32", "data64": data}


def _unpickle(data: bytes) -> Mapping[Any, Any]:
    is_zip = data.startswith(_ZIP_MARK)
    if is_zip:
        check_torch_archive(io.BytesIO(data))
    try:
        state = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        doubt = "" if is_zip else "is no state dict, is damaged, or "
        raise NPAError(
            f"the file {doubt}holds objects other than tensors, which could run code: export a "
            "plain state dict with torch.save(model.state_dict(), path)"
        ) from error
    except Exception as error:
        # What torch raises for garbage depends on where in its readers the garbage lands.
        raise NPAError(
            "this is no state dict of tensors that torch reads without running code, or a "
            f"truncated one ({shown(error)})"
        ) from error
    if not isinstance(state, Mapping):
        raise NPAError(f"the file must hold a state dict, got a {type(state).__name__}")
    return state


def _check_plain(name: str, tensor: Tensor) -> None:
    if tensor.layout != torch.strided or tensor.is_meta or tensor.is_nested or tensor.is_quantized:
        raise NPAError(
            f"{name} must be a dense tensor with data, got a sparse, meta, nested or quantised "
            "one: export the state dict with plain tensors"
        )
    held = tensor.untyped_storage().nbytes()
    if tensor.numel() * tensor.element_size() > held:
        raise NPAError(
            f"{name} must hold all its numbers, got shape {shown(tuple(tensor.shape))} of {held} "
            "bytes: export the state dict with tensors that are not expanded"
        )


def _matrix(name: str, value: Any) -> Tensor:
    """Return a weight or a bias; some of the authors' matrices come as 1x1 convolutions."""
    rank = 1 if name.endswith("bias") else 2
    if not isinstance(value, Tensor):
        raise NPAError(f"{name} must be a tensor, got a {type(value).__name__}")
    _check_plain(name, value)
    if value.ndim == 4 and rank == 2 and value.shape[2:] == (1, 1):
        value = value[:, :, 0, 0]
    if value.ndim != rank:
        raise NPAError(f"{name} must have {rank} dimension(s), got shape {tuple(value.shape)}")
    tensor: Tensor = value.detach().contiguous()
    return tensor


def _infer_dimensions(
    perception_dim: int, update_dim: int, channels: int | None
) -> tuple[int, int, bool]:
    """Find (D, C, static) with P = C(2+D)+D and A = C+D, or C where static."""
    found = []
    for space_dim in (2, 3):
        state_dim, rest = divmod(perception_dim - space_dim, 2 + space_dim)
        if rest or state_dim < 1 or channels not in (None, state_dim):
            continue
        if update_dim in (state_dim, state_dim + space_dim):
            found.append((space_dim, state_dim, update_dim == state_dim))
    if len(found) != 1:
        raise NPAError(
            "model.0.weight [H, C(2+D)+D] and model.2.weight [C+D or C, H] must fit one space "
            f"dimension D of 2 or 3, got {perception_dim} inputs and {update_dim} outputs, which "
            f"fit {len(found)}"
        )
    return found[0]


def _scalar(name: str, value: Any) -> float:
    """Return a number that the authors' tools may have rounded to float32 as the decimal meant."""
    if isinstance(value, Tensor):
        _check_plain(name, value)
        value = value.item() if value.numel() == 1 else value
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise NPAError(f"{name} must be a finite number, got {shown(value)}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise NPAError(f"{name} must be a finite number, got {shown(value)}")
    for digits in range(1, 10):
        rounded = float(f"{number:.{digits}g}")
        if _as_float32(rounded) == number:
            return rounded
    return number


def _as_float32(number: float) -> float:
    try:
        return float(struct.unpack("<f", struct.pack("<f", number))[0])
    except OverflowError:
        return math.inf


def _decode(entry: Mapping[str, Any], name: str, rank: int) -> Tensor:
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
    return torch.frombuffer(bytearray(data), dtype=torch.float32).reshape(shape)
