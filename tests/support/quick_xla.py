"""XLA flags of quick compilation: small shapes compile for longer than they run. Nothing here imports JAX."""

from importlib.metadata import version

DEVICES = "xla_force_host_platform_device_count"
# Level 0 compiles in two thirds of the time of level 1, with equal parity errors.
FLAGS = {"xla_backend_optimization_level": "0"}
# So do XLA's older fusion emitters (35 s for 53 of the CPU, a LoRA step of `tiny`), which JAX 0.11 no longer has.
if tuple(int(part) for part in version("jaxlib").split(".")[:2]) < (0, 11):
    FLAGS["xla_cpu_use_fusion_emitters"] = "false"


def spelled(flags: dict[str, str] = FLAGS) -> str:
    """As the environment variable XLA_FLAGS has them."""
    return " ".join(f"--{name}={value}" for name, value in flags.items())
