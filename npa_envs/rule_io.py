"""Rules as files: ours (safetensors), and the two formats of the paper's authors.

Ours holds the weights under `NPARule`'s own names and, in the header's metadata, the format's name
and version and every hyper-parameter, so that a file is all that is needed to run a rule. The
authors' formats are read by `npa_envs.rule_formats`.
"""

from __future__ import annotations

import json
import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, get_origin, get_type_hints

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as serialise
from torch import Tensor

from npa_envs.devices import check_device
from npa_envs.errors import NPAError, suggest
from npa_envs.files import checked_path, write_bytes
from npa_envs.rule import NPARule, RuleHyperParameters, check_rule
from npa_envs.rule_formats import RuleParts, read_demo_json, read_state_dict

FORMAT_NAME = "npa-envs rule"
FORMAT_VERSION = 1
_FIELDS = {
    name: str if get_origin(kind) is Literal else kind
    for name, kind in get_type_hints(RuleHyperParameters).items()
}
_RESERVED = {"format", "version", *_FIELDS}
_SUFFIXES = (".safetensors", ".pth", ".pt", ".json")


def shipped_rules(task: str | None = None) -> dict[str, Path]:
    """Return the rules that come with the package: name -> file, sorted by name.

    Args:
        task: Only those that were trained on this task, for example "morphogenesis2d".

    Raises:
        NPAError: The task is no text.
    """
    folder = Path(__file__).resolve().parent / "rules"
    rules = {path.stem: path for path in sorted(folder.glob("*.safetensors"))}
    if not isinstance(task, str | None):
        raise NPAError(f"task must be the name of one, got {task!r}: for example 'texture'")
    if task is None:
        return rules
    return {name: path for name, path in rules.items() if rule_metadata(path).get("task") == task}


def load_rule(source: str | Path, *, device: str | torch.device = "cpu") -> NPARule:
    """Load a rule: a shipped one by name, or a file in our format or one of the authors'.

    Args:
        source: The name of a shipped rule (`shipped_rules()`), or the path of a `.safetensors`
            file that `save_rule` wrote, of the authors' state dict (`.pth`, `.pt`; no code in it
            is run), or of their web demo's collection: `"models.json#name"`.
        device: Where the weights go: "cpu", "cuda", "cuda:1", or torch's own device.

    Returns:
        The rule, its weights in the precision of the file (float32 or float64). Torch's random
        state is left alone.

    Raises:
        NPAError: The name is unknown, the file is missing, garbage, truncated, of an unknown
            version, does not hold a rule, or holds weights that are not finite; or there is no
            such device.
    """
    target = check_device(device)
    path, name = _locate(source)
    try:
        if path.suffix == ".safetensors":
            rule = _assemble(_read_ours(path))
        elif path.suffix == ".json":
            rule = _assemble(read_demo_json(_read_file(path), name))
        else:
            rule = _assemble(read_state_dict(_read_file(path)))
    except NPAError as error:
        raise NPAError(f"cannot load a rule from {str(source)!r}: {error}") from error
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
            f"a rule's file must end in .safetensors, got {str(path)!r}: "
            f"use {str(path.with_suffix('.safetensors'))!r}"
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
                f"metadata must map text to text, got {name!r}: {text!r}: use str({text!r})"
            )
        if name in _RESERVED:
            raise NPAError(f"metadata must not use the name {name!r}: the format holds it itself")
        header[name] = text
    weights = {k: v.detach().cpu().contiguous() for k, v in rule.state_dict().items()}
    _check_finite(weights)
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
        raise NPAError(f"cannot read the header of {str(path)!r}: {error}") from error


def _locate(source: str | Path) -> tuple[Path, str | None]:
    """Find the file that `source` means, and the name after '#'."""
    text = str(source)
    known = shipped_rules()
    suffixes = ", ".join(_SUFFIXES)
    if not text:
        raise NPAError(
            "source must be the name of a shipped rule or the path of a file that ends in "
            f"{suffixes}, got '': names: {', '.join(known)}"
        )
    if text in known:
        return known[text], None
    base, mark, name = text.rpartition("#")
    path, inner = (Path(base), name) if mark and base.endswith(".json") else (Path(text), None)
    if path.suffix in _SUFFIXES:
        return path, inner
    try:
        exists = path.exists()
    except (OSError, ValueError) as error:
        raise NPAError(
            "source must be the name of a shipped rule or the path of a file that ends in "
            f"{suffixes}, got {reprlib.repr(text)}, which cannot be a path "
            f"({_reason(error)}): names: {', '.join(known)}"
        ) from error
    if exists:
        raise NPAError(f"a rule's file must end in {suffixes}, got {text!r}: rename it")
    raise NPAError(
        f"unknown rule {text!r}: {suggest(text, known)}; or give the path of a file that ends in "
        f"{suffixes}"
    )


def _read_file(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except (OSError, ValueError) as error:
        raise NPAError(_explain_unreadable(error)) from error


def _explain_unreadable(error: OSError | ValueError) -> str:
    return f"the file cannot be read ({_reason(error)}): check the path"


def _reason(error: OSError | ValueError) -> str:
    """Return the system's words without the path, or Python's for a path with a zero byte."""
    return (isinstance(error, OSError) and error.strerror) or str(error)


def _read_header(path: Path) -> dict[str, str]:
    try:
        with safe_open(path, framework="pt") as file:
            header: dict[str, str] = file.metadata() or {}
    except (OSError, ValueError) as error:
        raise NPAError(_explain_unreadable(error)) from error
    except SafetensorError as error:
        raise NPAError(f"this is no safetensors file, or a truncated one ({error})") from error
    _check_format(header)
    return header


def _check_format(header: Mapping[str, str]) -> None:
    if header.get("format") != FORMAT_NAME:
        raise NPAError(
            f"the metadata's format must be {FORMAT_NAME!r}, got {header.get('format')!r}: "
            "this safetensors file was not written by npa_envs.save_rule"
        )
    if header.get("version") != str(FORMAT_VERSION):
        raise NPAError(
            f"the metadata's version must be {FORMAT_VERSION}, got {header.get('version')!r}: "
            "upgrade with pip install -U npa-envs"
        )


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
        raise NPAError(f"the weights cannot be read ({error})") from error
    return RuleParts(hyper_parameters, weights)


def _parse(header: Mapping[str, str], name: str, kind: type) -> Any:
    if name not in header:
        raise NPAError(f"the metadata lacks {name!r}: save the rule again with npa_envs.save_rule")
    try:
        value = json.loads(header[name])
        if kind is float and type(value) is int:
            value = float(value)
    except (ValueError, OverflowError, RecursionError):
        value = None
    if type(value) is not kind:
        raise NPAError(
            f"the metadata's {name!r} must be a JSON {kind.__name__}, got {header[name]!r}"
        )
    return value


def _assemble(parts: RuleParts) -> NPARule:
    """Build the rule without drawing initial weights: shapes first, then the tensors themselves."""
    try:
        with torch.device("meta"):
            rule = NPARule(**parts.hyper_parameters)
    except (RuntimeError, TypeError, OverflowError) as error:
        raise NPAError(f"no rule has the hyper-parameters {parts.hyper_parameters}") from error
    expected = {name: tuple(tensor.shape) for name, tensor in rule.state_dict().items()}
    got = {name: tuple(tensor.shape) for name, tensor in parts.weights.items()}
    if got != expected:
        wrong = sorted(
            f"{name}: {got.get(name, 'missing')} instead of {expected.get(name, 'nothing')}"
            for name in expected.keys() | got.keys()
            if expected.get(name) != got.get(name)
        )
        raise NPAError(f"the weights must have the hyper-parameters' shapes, got {wrong}")
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
                f"the weights must be finite, got {bad} of {tensor.numel()} numbers in {name!r} "
                "NaN or infinite: take an earlier checkpoint, or train with a lower learning rate"
            )
