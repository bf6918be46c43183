"""Compile a program for accelerators that are not there: memory, kernels and collectives as their compiler says.

The compiler of NVIDIA GPUs is a plugin of JAX (extra `aot`); it needs neither a GPU nor a driver. It cannot say how long
a program takes, it does not try kernels out against each other, and NCCL's own buffers are not in its numbers.
"""

import contextlib
import dataclasses
import functools
import importlib.util
import math
import os
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np
from jax.sharding import AxisType, Mesh

from ..errors import UserError
from . import hlo, sharding, target

PLUGINS = ("jax_plugins.xla_cuda12", "jax_plugins.xla_cuda13")
INSTALL = "python -m pip install 'roge_jax[aot]'"
# JAX asks an attached GPU; the plugin of 0.10.2 knows cuDNN's graphs of this version.
CUDNN = 92800
# Without a device nothing is tried out: for some small products the compiler's default tiles do not exist.
NO_TRITON = {"xla_gpu_enable_triton_gemm": False}
NO_TILES = "Couldn't find output tile sizes"


@dataclasses.dataclass(frozen=True)
class Chip:
    """What the compiler of GPUs wants to know of one, beside name and memory."""

    capability: tuple[int, int]
    cores: int
    clock_ghz: float
    bandwidth: int  # bytes per second
    l2: int
    shared_core: int  # shared memory, bytes: of a core, and of a block at most
    shared_block: int
    threads: int  # of a core
    lanes: int  # float32 units of a core
    matrix_ops: int  # of one matrix unit and clock, 16 bit
    matrix_clock_ghz: float
    feature: str = "NONE"


_HOPPER = Chip(
    capability=(9, 0),
    cores=132,
    clock_ghz=1.98,
    bandwidth=3352320000000,
    l2=52428800,
    shared_core=233472,
    shared_block=232448,
    threads=2048,
    lanes=128,
    matrix_ops=512,
    matrix_clock_ghz=1.8295201,
    feature="ACCELERATED_FEATURES",
)
CHIPS = {
    "h100": _HOPPER,
    "h200": dataclasses.replace(_HOPPER, bandwidth=4800000000000),
    "a100": Chip(
        capability=(8, 0),
        cores=108,
        clock_ghz=1.41,
        bandwidth=2039040000000,
        l2=41943040,
        shared_core=167936,
        shared_block=166912,
        threads=2048,
        lanes=64,
        matrix_ops=512,
        matrix_clock_ghz=1.41,
    ),
    "rtx4090": Chip(
        capability=(8, 9),
        cores=128,
        clock_ghz=2.52,
        bandwidth=1008000000000,
        l2=75497472,
        shared_core=102400,
        shared_block=101376,
        threads=1536,
        lanes=128,
        matrix_ops=128,
        matrix_clock_ghz=2.52,
    ),
}


@dataclasses.dataclass(frozen=True)
class Compiled:
    """What the compiler says of one program, per device."""

    arguments: float  # bytes
    temporary: float
    output: float  # of it `alias` lies where arguments lay
    alias: float
    peak: float
    text: str  # the optimised module
    options: dict[str, Any]  # beside the defaults

    @property
    def bytes(self) -> float:
        """All that one device holds."""
        return self.arguments + self.temporary + self.output - self.alias

    @functools.cached_property
    def module(self) -> hlo.Summary:
        """Products, kernels, collectives and results of the module."""
        return hlo.summary(self.text)


def missing(name: str) -> str:
    """Why nothing can be compiled for the target `name` here; '' if it can."""
    if name not in CHIPS:
        return f"nothing is compiled ahead of time for {name}: the targets are {', '.join(CHIPS)}"
    if not any(_found(plugin) for plugin in PLUGINS):
        return f"the compiler of GPUs is not installed: {INSTALL}"
    return ""


def by_the_cpu() -> None:
    """Call it before anything asks JAX for devices: the CPU compiles, whatever else is here."""
    if not os.environ.get("JAX_PLATFORMS"):
        jax.config.update("jax_platforms", "cpu")


def check(name: str) -> None:
    """Raise UserError where `missing` says why nothing can be compiled for `name`."""
    if why := missing(name):
        raise UserError(f"--compile: {why}; or leave --compile out.")


def _found(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        return False


@contextlib.contextmanager
def compiling(name: str, sizes: tuple[int, int, int] = (1, 1, 1)) -> Iterator[Mesh]:
    """What is traced and compiled inside is for a mesh of `sizes` (data, fsdp, seq) of targets `name`.

    Raises UserError as `check` does.
    """
    check(name)
    from jax.experimental import topologies

    count = math.prod(sizes)
    topology = topologies.get_topology_desc(
        f"{name} x {count}",
        "cuda",
        target_config=gpu_description(name),
        topology=f"1x1x{count}",  # slices, hosts, devices
    )
    devices: np.ndarray = np.array(topology.devices).reshape(sizes)
    mesh = Mesh(devices, sharding.MESH_AXES, axis_types=(AxisType.Auto,) * 3)
    with (
        target.use(name, compiled=True),
        sharding.use(mesh),
        _answer_for_a_gpu(CHIPS[name].capability),
    ):
        yield mesh


def compiled(function: Callable, arguments: tuple, **jit: Any) -> Compiled:
    """`function`, jitted with the options `jit`, on abstract arguments that lie on the mesh of `compiling`.

    With the compiler's own flags; where it finds no tiles for a product, without Triton's products.
    """
    lowered = jax.jit(function, **jit).trace(*arguments).lower(lowering_platforms=("cuda",))
    options: dict[str, Any] = {}
    try:
        done = lowered.compile()
    except jax.errors.JaxRuntimeError as error:
        if NO_TILES not in str(error):
            raise
        options = NO_TRITON
        done = lowered.compile(compiler_options=options)
    memory = done.memory_analysis()
    return Compiled(
        arguments=memory.argument_size_in_bytes,
        temporary=memory.temp_size_in_bytes,
        output=memory.output_size_in_bytes,
        alias=memory.alias_size_in_bytes,
        peak=memory.peak_memory_in_bytes,
        text=done.as_text(),
        options=options,
    )


def report(said: dict[str, Compiled], name: str) -> str:
    """What `--dry-run --compile` prints: programs by name."""
    device, gb = target.TARGETS[name], 1e9
    columns = ("arguments", "temporary", "all", "TFLOP", "moved")
    lines = [
        f"{f'compiled for {device.title}':42s}" + "".join(f"{column:>12s}" for column in columns)
    ]
    for program, one in said.items():
        moved = sum(one.module.collectives.values())
        cells = (
            one.arguments / gb,
            one.temporary / gb,
            one.bytes / gb,
            one.module.all_flops / 1e12,
        )
        row = "".join(f"{x:12,.3g}" for x in (*cells, moved / gb))
        plain = (
            "" if not one.options else "  without Triton's products: its default tiles do not fit"
        )
        lines.append(f"{program:42s}{row}{plain}")
    lines.append(
        "GB of one device, as its compiler allots them; NCCL's buffers and fragmentation are not in it"
    )
    return "\n".join(lines)


def placed(tree: Any, where: Any) -> Any:
    """Abstract arrays of `tree` with the shardings `where` (one, or a tree of them)."""

    def leaf(x, sharding):
        return jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding)

    if isinstance(where, jax.sharding.NamedSharding):
        return jax.tree.map(lambda x: leaf(x, where), tree)
    return jax.tree.map(leaf, tree, where)


# ---- private parts of JAX: look at them again with every version -----------------------------------


@contextlib.contextmanager
def _answer_for_a_gpu(capability: tuple[int, int]) -> Iterator[None]:
    """JAX (0.10.2) asks an attached GPU for its compute capability and its cuDNN before it calls the fused attention.

    Where none is attached it has to be told: three private functions are replaced, and put back.
    """
    from jax._src.cudnn import fused_attention_stablehlo as fused

    def number(text: str) -> tuple[int, ...]:
        return tuple(int(x) for x in text.split("."))

    answers: dict[str, Callable] = {
        "check_cudnn_version": lambda: CUDNN,
        "check_compute_capability": lambda least: capability >= number(least),
        "is_cuda_compute_capability_equal": lambda other: capability == number(other),
    }
    before = {key: getattr(fused, key) for key in answers}
    try:
        for key, answer in answers.items():
            setattr(fused, key, answer)
        yield
    finally:
        for key, own in before.items():
            setattr(fused, key, own)


# ---- the description of a GPU ----------------------------------------------------------------------


def gpu_description(name: str) -> str:
    """A `GpuTargetConfigProto` as text, as the plugin of JAX 0.10.2 takes it: later ones have more fields."""
    chip, device = CHIPS[name], target.TARGETS[name]
    major, minor = chip.capability
    f16, f32, f64, bf16 = 10, 11, 12, 16  # XLA's primitive types

    def units(kind: str, rows: list[tuple]) -> str:
        form = "rate_infos {{ key: {} value {{ clock_rate_ghz: {} units_per_core: {} ops_per_clock: {} }} }}"
        return f"{kind} {{ {' '.join(form.format(*row) for row in rows)} }}"

    clock, fast, ops, lanes = chip.clock_ghz, chip.matrix_clock_ghz, chip.matrix_ops, chip.lanes
    scalar = [
        (f16, clock, lanes, 2),
        (f32, clock, lanes, 1),
        (f64, clock, lanes // 2, 1),
        (bf16, clock, lanes, 2),
    ]
    matrix = [(f16, fast, 4, ops), (f32, fast, 4, ops // 2), (bf16, fast, 4, ops)]
    return f"""gpu_device_info {{
  name: "{device.title}"
  device_vendor: "NVIDIA Corporation"
  platform_version: "Compute Capability {major}.{minor}"
  cuda_compute_capability {{ major: {major} minor: {minor} feature_extension: {chip.feature} }}
  device_memory_size: {int(device.memory or 0)}
  memory_bandwidth: {chip.bandwidth}
  pcie_bandwidth: 34359738368
  l2_cache_size: {chip.l2}
  clock_rate_ghz: {clock}
  core_count: {chip.cores}
  fpus_per_core: {lanes}
  threads_per_block_limit: 1024
  threads_per_warp: 32
  threads_per_core_limit: {chip.threads}
  thread_dim_limit_x: 1024 thread_dim_limit_y: 1024 thread_dim_limit_z: 64
  block_dim_limit_x: 2147483647 block_dim_limit_y: 65535 block_dim_limit_z: 65535
  registers_per_core_limit: 65536 registers_per_block_limit: 65536
  shared_memory_per_block: 49152
  shared_memory_per_block_optin: {chip.shared_block}
  shared_memory_per_core: {chip.shared_core}
  device_address_bits: 64
  ecc_enabled: true
  driver_version: "13.0.0" runtime_version: "12.9.0" compile_time_toolkit_version: "12.9.0"
  dnn_version: "9.10.0"
  device_interconnect_info {{ active_links: 18 }}
  {units("scalar_unit_description", scalar)}
  {units("matrix_unit_description", matrix)}
}}
platform_name: "CUDA"
dnn_version_info {{ major: 9 minor: 10 patch: 0 }}
runtime_version {{ major: 12 minor: 9 patch: 0 }}
device_description_str: "{device.title}"
"""
