"""Reading parity cases: inputs and outputs of the public PyTorch networks under made-up weights.

A case is a folder with `case.json` and `io.safetensors`. Small ones live in `tests/fixtures`, larger ones in the
optional developer data, `$ROGE_DEV_DATA/parity`; a test whose case is in neither is skipped with that reason.

    case = load_case("wan_vae_tiny")
    weights = rule_weights(case)           # {official key: float32 array}
    out = network(convert(weights), case.tensors["in.video_T5"])
    assert rel_l2(out, case.tensors["out.latent_T5"]) <= 1e-5

The weights follow the rule "sinfrac": the sorted key number n and the flat index i give
u = frac(43758.5453 sin(c1 (i + 1) + c2 n)) in float64 and w = base + a sqrt(3) (2 u - 1), where base and a depend on
the kind of tensor (`kind_of`). Tolerance: 1e-5 in relative L2 per tensor; two independent float32 programs differ by
less than 2.5e-6 on these cases, and wrong formulas by more than 4e-5.
"""

import json
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

FIXTURES = Path(__file__).parents[1] / "fixtures"


class Case(NamedTuple):
    name: str
    folder: Path
    info: dict[str, Any]  # case.json
    tensors: dict[str, np.ndarray]  # in.*, mid.*, out.*

    @property
    def config(self) -> dict[str, Any]:
        return self.info["config"]


def dev_data() -> Path | None:
    """The optional developer data, a folder with `parity/` and `scenes/`."""
    root = os.environ.get("ROGE_DEV_DATA")
    return Path(root) if root else None


def find_case(name: str) -> Path:
    """The case's folder; skips the calling test if there is none."""
    folders = [FIXTURES / name] + ([dev_data() / "parity" / name] if dev_data() else [])
    for folder in folders:
        if (folder / "case.json").exists():
            return folder
    pytest.skip(
        f"parity case {name} is not in tests/fixtures; set ROGE_DEV_DATA to the developer data"
    )


def load_case(name: str) -> Case:
    from safetensors.numpy import load_file

    folder = find_case(name)
    info = json.loads((folder / "case.json").read_text())
    return Case(name, folder, info, load_file(folder / "io.safetensors"))


def key_listing(name: str) -> list[dict[str, Any]]:
    """Every key of a full-size model: dicts with the columns of `key_listings/<name>.json`, shape as a tuple."""
    path = find_listing(name)
    rows = json.loads(path.read_text())
    keys = rows["columns"]
    return [dict(zip(keys, row, strict=True)) | {"shape": tuple(row[1])} for row in rows["keys"]]


def find_listing(name: str) -> Path:
    roots = [FIXTURES] + ([dev_data() / "parity"] if dev_data() else [])
    for root in roots:
        if (path := root / "key_listings" / f"{name}.json").exists():
            return path
    pytest.skip(
        f"key listing {name} is not in tests/fixtures; set ROGE_DEV_DATA to the developer data"
    )


def kind_of(key: str, shape: tuple[int, ...]) -> str:
    if key.endswith("gamma") or (len(shape) == 1 and key.endswith("weight")):
        return "gain"
    if len(shape) > 1 and shape[0] == 1:
        return "token"
    return "bias" if len(shape) == 1 else "matrix"


def rule_tensor(n: int, key: str, shape: tuple[int, ...], rule: dict) -> np.ndarray:
    """Tensor number `n` (keys sorted) of the rule, float32."""
    i = np.arange(1, int(np.prod(shape)) + 1, dtype=np.float64)
    s = np.sin(rule["c1"] * i + rule["c2"] * n) * 43758.5453
    u = s - np.floor(s)
    kind = kind_of(key, shape)
    a = rule["std"][kind]
    if kind == "matrix":
        a = a / np.sqrt(np.prod(shape[1:]))
    base = 1.0 if kind == "gain" else 0.0
    return (base + a * np.sqrt(3.0) * (2.0 * u - 1.0)).astype(np.float32).reshape(shape)


def state_shapes(case: Case) -> dict[str, tuple[int, ...]]:
    """{official key: shape}, keys sorted, from the case's `state_dict_keys`."""
    return {row[0]: tuple(row[1]) for row in sorted(case.info["state_dict_keys"])}


def rule_weights(case: Case) -> dict[str, np.ndarray]:
    """{official key: float32 array}, checked against the probes stored with the case.

    Keys that the reference keeps in bfloat16 are rounded to it (and returned as float32).
    """
    import ml_dtypes

    rule = case.info["weights"]["rule"]
    weights = {}
    for n, (key, shape, dtype) in enumerate(sorted(case.info["state_dict_keys"])):
        value = rule_tensor(n, key, tuple(shape), rule)
        if dtype == "bfloat16":
            value = value.astype(ml_dtypes.bfloat16).astype(np.float32)
        weights[key] = value
    for key, probe in case.info["weights"].get("probes", {}).items():
        flat = weights[key].ravel().astype(np.float64)
        got = np.array([flat[0], flat[-1], flat.mean()])
        want = np.array([probe["first"], probe["last"], probe["mean"]])
        np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-6, err_msg=key)
    return weights


def rel_l2(a, b) -> float:
    """|a - b| / |b| in float64; the shapes must agree."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    assert a.shape == b.shape, (a.shape, b.shape)
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))
