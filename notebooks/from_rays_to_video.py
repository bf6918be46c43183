# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From rays to video
#
# RoGe, one stage at a time, with plain dicts: photos → scene tokens → ray features → condition → velocity → video.
# Everything below is a pure function of the parameter tree; nothing is hidden in objects. It runs in under a minute on a laptop's CPU.

# %%
# Away from a checkout, on Colab for example, this installs the package. In a checkout it does nothing.
import importlib.util
import subprocess
import sys
from pathlib import Path

if importlib.util.find_spec("roge_jax") is None:
    source = ".." if Path("../pyproject.toml").exists() else "roge_jax"
    subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", source, "matplotlib"], check=True)

# %%
import functools

import jax
import matplotlib.pyplot as plt
import numpy as np

import roge_jax as rj
from roge_jax.core.params import count, flatten
from roge_jax.geometry.rays import plucker
from roge_jax.video import flow, solvers

params, config = rj.load("mini")
for part, tree in params.items():
    print(f"{part:10s} {count(tree):>10,} parameters in {len(flatten(tree))} leaves")

# %% [markdown]
# ## A scene and a path
# Two real photos that come with scikit-image. Any folder with a nerfstudio `transforms.json` works the same way.

# %%
scene, contexts = rj.load_scene("motorcycle"), [0, 1]
photos = rj.sampling.read_photos(scene, contexts, config)
path = rj.make_path("interpolate", photos.cameras, config.frames)
views, info = rj.sampling.make_views(photos, path, config)
print({name: array.shape for name, array in views.items()})

# %% [markdown]
# ## Rays
# Every pixel of every view is a Plücker ray $[d,\ o \times d]$. The first context camera is the world frame.

# %%
rays = plucker(views["K"], views["c2w"], config.height, config.width)
print(rays.shape, "unit directions:", bool(np.allclose(np.linalg.norm(rays[..., :3], axis=-1), 1, atol=1e-5)))

# %% [markdown]
# ## Reconstruct and query
# Scene tokens come from the photos alone; the rays of *all* views then read them. The RGB head shows what they know.

# %%
tokens = jax.jit(functools.partial(rj.model.reconstruct, config=config))(params, views)
features = jax.jit(functools.partial(rj.model.query_rays, config=config))(params, tokens, views)
preview = jax.jit(functools.partial(rj.model.decode_rgb, config=config))(params, features, views)
print("scene tokens", tokens.shape, "ray features", features.shape)

# %% [markdown]
# ## Condition and generate
# `prepare` does the two steps above once more together with the photos' latents; `generate` integrates
# $\mathrm{d}x/\mathrm{d}\sigma = V(x, \sigma; C)$ from noise to latents, by the sampler that the model's configuration names.

# %%
prepared = jax.jit(functools.partial(rj.model.prepare, config=config))(params, views, scene_tokens=tokens)
noise = rj.model.draw_noise(jax.random.key(0), len(contexts), config=config)
grid = flow.schedule(config.flow.schedule, config.flow.steps, shift=config.flow.shift)
sample = jax.jit(functools.partial(rj.model.generate, config=config, solver=solvers.tabulate(config.flow.solver, grid)))
latents, info = sample(params, prepared, noise)
solvers.raise_if_failed(info)
decode = jax.jit(functools.partial(rj.model.decode_video, config=config))
video = decode(params, latents, detail=prepared.detail)
print("latents", latents.shape, "video", video.shape, "evaluations", int(info.evaluations))

# %%
shown = np.linspace(0, config.frames - 1, 5).astype(int)
figure, axes = plt.subplots(3, 5, figsize=(10, 3.6))
for column, frame in enumerate(shown):
    top = photos.images[column] if column < len(contexts) else np.ones_like(photos.images[0])
    for axis, image in zip(axes[:, column], (top, preview[len(contexts) + frame], video[frame])):
        axis.imshow(np.clip(image, 0, 1))
        axis.axis("off")
for axis, label in zip(axes[:, 0], ("photos", "preview", "video")):
    axis.set_title(label, loc="left", fontsize=9)
figure.tight_layout()
