"""Files of rules: `save_rule` writes safetensors, `load_rule` reads them and the authors' formats.

A file has the weights under `NPARule`'s names and, in the header's metadata, the format's name and
version, every hyper-parameter, and a SHA-256 checksum over all of that.
"""

from __future__ import annotations

import hashlib
import json
import mimetypes
import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_origin

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as serialise
from torch import Tensor

from npa_envs.atomic_files import checked_path, open_regular, parse_json, read_bytes, write_bytes
from npa_envs.checks import check_device
from npa_envs.errors import NPAError, shown, suggest
from npa_envs.rule.paper_formats import (
    ZIP_MARK,
    RuleParts,
    check_weights,
    read_demo_json,
    read_state_dict,
)
from npa_envs.rule.rule import HYPER_PARAMETERS, NPARule, check_rule, is_altered

FORMAT_NAME = "npa-envs rule"
FORMAT_VERSION = "1"

_PLAIN: dict[Any, type] = {Literal: str, Sequence: tuple}
_FIELDS = {name: _PLAIN.get(get_origin(cls), cls) for name, cls in HYPER_PARAMETERS.items()}
_RESERVED = {"format", "version", "checksum", *_FIELDS}
_SUFFIXES = (".safetensors", ".pth", ".pt", ".json")
_MAX_FILE = 64 * 2**20
"""Largest file of a rule [bytes]; the largest shipped one has 0.1 MiB."""


def shipped_rules(task: str | None = None) -> dict[str, Path]:
    """Return the rules that come with the package: name -> file, sorted by name.

    Args:
        task: Return only rules of this task, for example "morphogenesis2d".

    Raises:
        NPAError: The task is not a string.
    """
    folder = Path(__file__).resolve().parent / "shipped"
    rules = {path.stem: path for path in sorted(folder.glob("*.safetensors"))}
    if not isinstance(task, str | None):
        raise NPAError(f"task must be the name of one, got {shown(task)}: for example 'texture'")
    if task is None:
        return rules
    return {name: path for name, path in rules.items() if rule_metadata(path).get("task") == task}


def preset_rules() -> dict[str, Path]:
    """Return the rules that presets and environments start from: name -> file, sorted by name.

    They do not change when a shipped rule of the same picture is trained again.
    """
    folder = Path(__file__).resolve().parent / "initial"
    return {path.stem: path for path in sorted(folder.glob("*.safetensors"))}


def load_rule(source: str | Path, *, device: str | torch.device = "cpu") -> NPARule:
    """Load a rule: a shipped one by name, or a file in our format or one of the authors'.

    Args:
        source: The name of a rule (`shipped_rules()`, `preset_rules()`), or the path of a
            `.safetensors` file that `save_rule` wrote, of the authors' state dict (`.pth`, `.pt`;
            no code in it is run), or of their web demo's collection: `"models.json#name"`, or of a
            stack of rules without names `"models_digits.json#0"`; or a training run's folder.
        device: Where the weights go: "cpu", "cuda", "cuda:1", or torch's own device.

    Returns:
        The rule, its weights in the precision of the file (float32 or float64). Torch's random
        state is not changed. A file without a checksum, in which damage cannot be detected, is
        loaded with a `UserWarning`: the authors' `.json`, and state dicts in torch's format before
        1.6.

    Raises:
        NPAError: The name is unknown, the file is missing, garbage, truncated, of an unknown
            version, has no rule in it or weights that are not finite, or has changed since it
            was written; or there is no such device.
    """
    target = check_device(device)
    path, name = _locate(source)
    try:
        content, ours = b"", path.suffix == ".safetensors"
        if ours:
            header, weights = read_tensors(path)
            fields = {name: _hyper_parameter(header, name, cls) for name, cls in _FIELDS.items()}
            parts = RuleParts(fields, weights)
        else:
            content = read_bytes(path, limit=_MAX_FILE, what="it")
            is_demo = path.suffix == ".json"
            parts = read_demo_json(content, name) if is_demo else read_state_dict(content)
        rule = _rule_of(parts)
        if ours:
            check_checksum(header, weights)
    except NPAError as error:
        raise NPAError(f"cannot load a rule from {shown(str(source))}: {error}") from error
    if not (ours or content.startswith(ZIP_MARK)):
        warnings.warn(
            f"the rule's file {shown(str(path))} has no checksum, so damage cannot be detected: "
            "if it is known to be good, save it again with npa_envs.save_rule",
            stacklevel=2,
        )
    return rule.to(target)


def save_rule(
    rule: NPARule, path: str | Path, *, metadata: Mapping[str, str] | None = None
) -> None:
    """Write a rule with all hyper-parameters to a `.safetensors` file, completely or not at all.

    The same rule and metadata give the same bytes.

    Args:
        rule: The rule; its weights are written in their own precision.
        path: The file to write, ending in `.safetensors`; an existing one is replaced.
        metadata: Further text for the header, for example how the rule was trained.

    Raises:
        NPAError: The rule's network is not that of `NPARule`; the suffix is another one, the
            metadata is not text or takes a reserved name, the weights are not finite or not all
            float32 or all float64, or the file cannot be written.
    """
    check_rule(rule)
    # A module of torch.compile has other names of weights.
    rule = getattr(rule, "_orig_mod", rule)
    if not _fits_a_file(rule):
        raise NPAError(
            f"rule must have the network of NPARule, got a {type(rule).__name__} with another "
            "one, which the file would not contain: remove its hooks, or keep its state_dict "
            "with torch.save, for load_state_dict of the same class"
        )
    path = checked_path(path)
    if path.suffix != ".safetensors":
        raise NPAError(
            f"a rule's file must end in .safetensors, got {shown(str(path))}: "
            f"use {shown(str(path.with_suffix('.safetensors')))}"
        )
    header = {name: json.dumps(value) for name, value in rule.hyper_parameters().items()}
    header |= _checked_metadata({} if metadata is None else metadata)
    weights = {k: v.detach().cpu().contiguous() for k, v in rule.state_dict().items()}
    write_tensors(path, FORMAT_NAME, header, weights)


def _checked_metadata(metadata: Mapping[str, str]) -> Mapping[str, str]:
    """Return the metadata of a rule's file; raise NPAError unless a header can hold it."""
    if not isinstance(metadata, Mapping):
        raise NPAError(
            f"metadata must map text to text, got {type(metadata).__name__}: for example "
            "metadata={'trained by': 'me'}"
        )
    for name, text in metadata.items():
        came = f"got {shown(name)}: {shown(text)}"
        if not isinstance(name, str) or not isinstance(text, str):
            raise NPAError(f"metadata must map text to text, {came}: use str()")
        if any("\ud800" <= letter <= "\udfff" for letter in name + text):
            raise NPAError(
                f"metadata must be text that UTF-8 can write, {came}: leave single surrogates out"
            )
        if name in _RESERVED:
            raise NPAError(
                f"metadata must not use the name {shown(name)}: the format holds it itself"
            )
    return metadata


def _fits_a_file(rule: NPARule) -> bool:
    """Return whether a rule has the layers of `NPARule` only and no hooks, so a file holds all."""
    loaded = _without_weights(rule.hyper_parameters())
    same_shapes = _shapes(rule.state_dict()) == _shapes(loaded.state_dict())
    if type(rule).forward is not NPARule.forward or is_altered(rule) or not same_shapes:
        return False
    modules = dict(rule.named_modules())
    for name, module in loaded.named_modules():
        if name and (type(modules.get(name)) is not type(module) or is_altered(modules[name])):
            return False
    return True


def _with_sorted_metadata(file: bytes) -> bytes:
    """Return the bytes of a safetensors file with its metadata sorted, the same for equal rules."""
    size = int.from_bytes(file[:8], "little")
    header = json.loads(file[8 : 8 + size])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    # The format asks for tensors that begin at a multiple of 8 bytes, after spaces.
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + file[8 + size :]


def rule_metadata(path: str | Path) -> dict[str, str]:
    """Return the metadata in the header of a file that `save_rule` wrote."""
    try:
        return read_tensors(checked_path(path), with_weights=False)[0]
    except NPAError as error:
        raise NPAError(f"cannot read the header of {shown(str(path))}: {error}") from error


def rule_digest(rule: NPARule) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 of a rule's weights."""
    digest = hashlib.sha256()
    for weight in rule.state_dict().values():
        digest.update(weight.cpu().numpy().tobytes())
    return digest.hexdigest()[:16]


def rule_file(source: str | Path) -> Path:
    """Return the path of the file that `load_rule(source)` reads."""
    return _locate(source)[0]


def rule_name(source: str) -> str:
    """Return a short name of a rule: what follows "#", or else its file's name without suffix.

    Of a run's rule.safetensors it is the folder's name.
    """
    if "#" in source:
        return source.rpartition("#")[2]
    path = rule_file(source)
    return path.resolve().parent.name if path.name == "rule.safetensors" else path.stem


def _locate(source: str | Path) -> tuple[Path, str | None]:
    """Return the file that `source` names, and the rule's name in it: what follows "#", or None."""
    if not isinstance(source, str | os.PathLike):
        raise NPAError(
            f"source must be a rule's name or the path of its file, got {shown(source)}: "
            "for example 'gecko'"
        )
    text = str(source)
    suffixes = ", ".join(_SUFFIXES)
    named = shipped_rules() | preset_rules()
    if text in named:
        return named[text], None
    if os.path.isdir(text):
        rule = Path(text) / "rule.safetensors"
        if rule.is_file():
            return rule, None
        others = sorted(Path(text).glob("rule-*.safetensors"))
        hint = f"one of its rules, such as {str(others[0])!r}" if others else "another one"
        raise NPAError(
            f"a folder must hold the {rule.name} of a run, {text!r} does not: name {hint}"
        )
    base, mark, name = text.rpartition("#")
    path, inner = (Path(base), name) if mark and base.endswith(".json") else (Path(text), None)
    if path.suffix in _SUFFIXES:
        return path, inner
    if os.path.exists(text):
        is_picture = (mimetypes.guess_type(text, strict=False)[0] or "").startswith("image/")
        cure = f"npa-envs train morphogenesis2d --target {shown(text)} trains a rule of it"
        raise NPAError(
            f"a rule's file must end in {suffixes}, got {shown(text)}: "
            f"{cure if is_picture else 'give the file of a rule, or the folder of a run'}"
        )
    if os.path.dirname(text):
        raise NPAError(f"cannot load a rule from {shown(text)}: it does not exist: check the path")
    run = os.path.join("runs", text)
    if os.path.isfile(os.path.join(run, "rule.safetensors")):
        raise NPAError(f"unknown rule {shown(text)}: did you mean the run {shown(run)}?")
    raise NPAError(
        f"unknown rule {shown(text)}: {suggest(text, shipped_rules())}; or give the path of a "
        f"file that ends in {suffixes}, or a run's folder"
    )


def write_tensors(
    path: Path, format_name: str, metadata: Mapping[str, str], weights: dict[str, Tensor]
) -> None:
    """Write metadata and weights, all finite, to a safetensors file with a checksum over both."""
    check_weights(weights)
    header = {"format": format_name, "version": FORMAT_VERSION, **metadata}
    header["checksum"] = _checksum(header, weights)
    write_bytes(path, _with_sorted_metadata(serialise(weights, metadata=header)))


def read_tensors(
    path: Path, format_name: str = FORMAT_NAME, *, with_weights: bool = True
) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Return the metadata of a file of `write_tensors`, and its weights by name, unchecked.

    Without `with_weights` there are none.
    """
    open_regular(path, limit=_MAX_FILE, what="it").close()
    try:
        with safe_open(path, framework="pt") as file:
            header: dict[str, str] = file.metadata() or {}
            names = list(file.keys()) if with_weights else []
            weights = {name: file.get_tensor(name).clone() for name in names}
    except (OSError, ValueError, SafetensorError) as error:
        raise NPAError(
            f"no safetensors file, or a truncated one ({shown(error)}): download or copy it again"
        ) from error
    if header.get("format") != format_name:
        raise NPAError(
            f"the metadata's format must be {format_name!r}, got {shown(header.get('format'))}: "
            f"this safetensors file has no {format_name.split()[-1]} of npa_envs"
        )
    if header.get("version") != FORMAT_VERSION:
        raise NPAError(
            f"the metadata's version must be {FORMAT_VERSION}, got "
            f"{shown(header.get('version'))}: upgrade with pip install -U npa-envs"
        )
    return header, weights


def check_checksum(header: Mapping[str, str], weights: Mapping[str, Tensor]) -> None:
    """Raise NPAError unless a file's checksum is that of its metadata and weights."""
    if header.get("checksum") != _checksum(header, weights):
        raise NPAError(
            "the checksum must be that of the weights and of the metadata, got another one: "
            "the file is damaged, or another program has changed it; copy it again from where "
            "it came"
        )


def _checksum(header: Mapping[str, str], weights: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 of the metadata, without the checksum, and of all weights."""
    content: list[Any] = sorted(item for item in header.items() if item[0] != "checksum")
    content += [(name, str(w.dtype), *w.shape) for name, w in sorted(weights.items())]
    digest = hashlib.sha256(json.dumps(content).encode())
    for _, tensor in sorted(weights.items()):
        digest.update(tensor.numpy().tobytes())
    return digest.hexdigest()


def _hyper_parameter(header: Mapping[str, str], name: str, cls: type) -> Any:
    """Return the hyper-parameter `name` in a file's metadata, of type `cls`."""
    if name not in header:
        raise NPAError(f"the metadata lacks {name!r}: save the rule again with npa_envs.save_rule")
    try:
        value = parse_json(header[name])
        if cls is float and type(value) is int:
            value = float(value)
        if cls is tuple and type(value) is list:
            value = tuple(value)
    except (NPAError, OverflowError):
        value = None
    if type(value) is not cls:
        raise NPAError(
            f"the metadata's {name!r} must be a JSON {cls.__name__}, got {shown(header[name])}"
        )
    return value


def _without_weights(hyper_parameters: Mapping[str, Any]) -> NPARule:
    """Return a rule on torch's meta device, where weights have a shape and no values."""
    try:
        with torch.device("meta"):
            return NPARule(**hyper_parameters)
    except (RuntimeError, TypeError, OverflowError) as error:
        raise NPAError(f"no rule has the hyper-parameters {shown(hyper_parameters)}") from error


def rule_like(hyper_parameters: Mapping[str, Any]) -> NPARule:
    """Return a rule on the CPU with uninitialised weights, for a state dict to be loaded into."""
    return _without_weights(hyper_parameters).to_empty(device="cpu")


def _shapes(weights: Mapping[str, Tensor]) -> dict[str, tuple[int, ...]]:
    return {name: tuple(tensor.shape) for name, tensor in weights.items()}


def _rule_of(parts: RuleParts) -> NPARule:
    """Return the rule with these hyper-parameters and weights; torch's random state is kept."""
    rule = _without_weights(parts.hyper_parameters)
    expected, got = _shapes(rule.state_dict()), _shapes(parts.weights)
    if got != expected:
        wrong = sorted(
            f"{name}: {got.get(name, 'missing')} instead of {expected.get(name, 'nothing')}"
            for name in expected.keys() | got.keys()
            if expected.get(name) != got.get(name)
        )
        raise NPAError(f"the weights must have the hyper-parameters' shapes, got {shown(wrong)}")
    check_weights(parts.weights)
    rule.load_state_dict(dict(parts.weights), assign=True)
    return rule.requires_grad_()
