"""The two file formats in which the paper's authors publish their rules, as our own parts.

State dict (`npa.pth`): `model.0.weight` [H, P], `model.0.bias` [H], `model.2.weight` [A, H] with
rows [δ (D); Δs (C)], `eps0`, `alpha`, and for rules with a read-out `decoder.0.*`, `decoder.2.*`.
Web demo (`models.json`): for each name `w1.weight` [H, P], `w1.bias`, `w2.weight.T` [H, A] with
columns [Δs (C), δ (2)], both padded with zeros to a multiple of four columns; float32 in base64.
"""

from __future__ import annotations

import base64
import binascii
import io
import json
import math
import pickle
import reprlib
import struct
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from npa_envs.errors import NPAError, suggest

_DEMO_SPACE_DIM = 2
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


@dataclass(frozen=True)
class RuleParts:
    """A rule taken apart: what `NPARule` is made with, and its weights by its own names."""

    hyper_parameters: dict[str, Any]
    weights: dict[str, Tensor]


def read_state_dict(data: bytes) -> RuleParts:
    """Read the authors' state dict.

    The space dimension and the number of channels follow from the shapes.

    Args:
        data: The content of the `.pth` file.

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
            f"{sorted(map(str, unknown))}"
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
    return RuleParts(hyper_parameters, weights)


def read_demo_json(data: bytes, name: str | None) -> RuleParts:
    """Read one rule of the authors' web demo.

    Args:
        data: The content of the JSON file.
        name: The rule's name in it; None where the file holds one only.

    Raises:
        NPAError: This is not such a file, or it has no rule of that name.
    """
    try:
        collection = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise NPAError(f"this is no JSON file, or a truncated one ({error})") from error
    names = sorted(collection) if isinstance(collection, dict) else []
    if not names or not all(isinstance(collection[known], dict) for known in names):
        raise NPAError("the JSON file must map names to rules, as the authors' web demo has them")
    if name is None and len(names) > 1:
        raise NPAError(f"the file holds several rules: add #name; names: {', '.join(names)}")
    name = names[0] if name is None else name
    if name not in collection:
        raise NPAError(f"the file holds no rule {name!r}: {suggest(name, names)}")
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


def _unpickle(data: bytes) -> Mapping[Any, Any]:
    is_zip = data.startswith(_ZIP_MARK)
    if is_zip:
        _check_zip(data)
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
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise NPAError(
            "this is no state dict of tensors that torch reads without running code, or a "
            f"truncated one ({reason[:200]})"
        ) from error
    if not isinstance(state, Mapping):
        raise NPAError(f"the file must hold a state dict, got a {type(state).__name__}")
    return state


def _check_zip(data: bytes) -> None:
    """Compare the checksums, which torch does not look at."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            bad = archive.testzip()
    except Exception as error:
        # What zipfile raises depends on where the damage lies.
        raise NPAError(
            f"the file is damaged or truncated ({type(error).__name__}): fetch or save it again"
        ) from error
    if bad is not None:
        raise NPAError(f"the file is damaged (wrong checksum of {bad!r}): fetch or save it again")


def _check_plain(name: str, tensor: Tensor) -> None:
    if tensor.layout != torch.strided or tensor.is_meta or tensor.is_nested or tensor.is_quantized:
        raise NPAError(
            f"{name} must be a dense tensor with data, got a sparse, meta, nested or quantised "
            "one: export the state dict with plain tensors"
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
        raise NPAError(f"{name} must be a finite number, got {reprlib.repr(value)}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise NPAError(f"{name} must be a finite number, got {reprlib.repr(value)}")
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
        raise NPAError(f"{name} must be float32 with {rank} dimension(s), got {dtype!r} {shape!r}")
    try:
        data = base64.b64decode(packed["data64"], validate=True)
    except (binascii.Error, TypeError, ValueError) as error:
        raise NPAError(f"the data of {name} is no base64 text ({error})") from error
    if len(data) != 4 * math.prod(shape):
        raise NPAError(
            f"the data of {name} must be {4 * math.prod(shape)} bytes for shape {shape}, got "
            f"{len(data)}: the file is damaged"
        )
    return torch.frombuffer(bytearray(data), dtype=torch.float32).reshape(shape)
