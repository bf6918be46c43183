"""The Python of docs/howto/library.md runs as it is printed, on the tiny model, in a folder of its own (slow: it compiles
every stage); its table names all that is public."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

PAGE = (Path(__file__).parents[2] / "docs" / "howto" / "library.md").read_text()
LOAD = 'params, config = rj.load("mini")\n'
TINY = (
    'config = rj.preset("tiny")\nparams = rj.model.init(jax.random.key(0), config)\n'
    'head = params["renderer"]["rgb_head"]["linear"]  # zero at first: no gradient would pass\n'
    'head["kernel"] = 0.1 * jax.random.normal(jax.random.key(1), head["kernel"].shape)\n'
    'rj.save("small", params, config, dtype=jnp.float32)\nparams, config = rj.load("small")\n'
)
CHECKS = """
assert tokens.shape[0] == m == 2 and slope.shape == (m + config.frames, 4, 4)
assert np.isfinite(value) and np.abs(np.asarray(slope)[:, :3]).max() > 0
np.testing.assert_allclose(rj.load_path("path.json").c2w, path.c2w, atol=1e-9)
assert video.shape == (config.frames, config.height, config.width, 3)
assert result.frames.shape == video.shape and result.evaluations == 3
total, terms = jax.eval_shape(joint, params, {}, draw_batch(data, 0, 0, 1, drawn, scale_rule=config.scale_rule), jax.random.key(0))
assert set(terms) == {"flow", "photometric", "x0"}
assert x.shape == noise.shape and np.isfinite(np.asarray(x)).all()
assert trees.flatten(trained).keys() == trees.flatten(params).keys()
before, after = (trees.flatten(t)["renderer/rgb_head/linear/kernel"] for t in (params, trained))
assert not np.array_equal(before, after)
trees.check(trained, model.specs(config))
"""


@pytest.mark.slow
def test_the_page_runs(tmp_path):
    blocks = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    code = "\n".join(blocks)
    assert len(blocks) == 8 and code.count(LOAD) == 1
    code = code.replace(LOAD, TINY) + CHECKS
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]


def test_every_public_name_is_explained():
    import roge_jax

    missing = [
        name
        for name in roge_jax.__all__
        if name not in ("__version__", "config") and f"`rj.{name}" not in PAGE
    ]
    assert not missing, missing
