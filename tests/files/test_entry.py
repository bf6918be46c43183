"""What every program shares: exit codes, messages, the compilation cache, records and output folders."""

import argparse
import json
import os
import shutil
import subprocess
import sys

import pytest

from roge_jax.errors import UserError
from roge_jax.files import entry
from roge_jax.files.folders import (
    check_disk,
    keep_settings,
    output_file,
    output_folder,
    put,
    write_json,
)


def program(main, *arguments):
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=entry.number(1), default=3)
    parser.add_argument("--rate", type=entry.number(0.5, whole=False), default=1.0)
    parser.add_argument("--solver", type=entry.one_of(["euler", "heun"]), default="euler")
    parser.add_argument("--share", type=entry.number(0, 1, whole=False))
    parser.add_argument("--debug", action="store_true")
    return entry.execute(main, parser, arguments)


def failing(error):
    def main(args):
        raise error

    return main


class TestExitCodes:
    def test_fine_is_zero_and_a_returned_number_is_the_code(self):
        assert program(lambda args: None) == 0
        assert program(lambda args: {"anything": 1}) == 0
        assert program(lambda args: 7) == 7

    def test_mistakes_are_one_sentence_and_2(self, capsys):
        assert program(failing(UserError("photo.png: is torn: copy it again."))) == 2
        assert capsys.readouterr().err == "error: photo.png: is torn: copy it again.\n"

    def test_debug_shows_the_traceback(self, capsys):
        assert program(failing(UserError("torn.")), "--debug") == 2
        shown = capsys.readouterr().err
        assert "Traceback" in shown and "in main" in shown

    def test_interrupt_is_130(self):
        assert program(failing(KeyboardInterrupt())) == 130

    def test_a_stopped_computation_is_1(self, capsys):
        from roge_jax.video.solve_info import SamplingError

        assert program(failing(SamplingError("The velocity is not finite at step 3."))) == 1
        assert capsys.readouterr().err == "error: The velocity is not finite at step 3.\n"

    @pytest.mark.parametrize(
        ("error", "code", "said"),
        [
            (
                OSError(28, "No space left on device", "/x/a.png"),
                2,
                "/x/a.png: No space left on device: free some",
            ),
            (
                PermissionError(13, "Permission denied", "/x"),
                2,
                "/x: Permission denied: ask for the right",
            ),
            (OSError(36, "File name too long", "x" * 5000), 2, "give a shorter name"),
            (MemoryError("7 TiB"), 1, "Out of memory (7 TiB): ask for less"),
            (
                RuntimeError("RESOURCE_EXHAUSTED: 9 GB"),
                1,
                "Out of memory (RESOURCE_EXHAUSTED: 9 GB)",
            ),
        ],
    )
    def test_what_the_system_refuses_is_one_sentence(self, error, code, said, capsys):
        assert program(failing(error)) == code
        shown = capsys.readouterr().err
        assert shown.startswith("error: ") and said in shown
        assert shown.count("\n") == 1 and len(shown) < 400

    def test_faults_of_the_program_are_not_dressed_up(self):
        with pytest.raises(RuntimeError, match="internal"):
            program(failing(RuntimeError("internal")))

    def test_run_leaves_the_process(self):
        with pytest.raises(SystemExit) as left:
            entry.run(lambda args: 5, argparse.ArgumentParser(), [])
        assert left.value.code == 5

    def test_a_reader_that_has_enough_is_no_fault(self):
        code = (
            "import argparse; from roge_jax import entry\n"
            "def main(args):\n    while True: print('x' * 1000)\n"
            "entry.run(main, argparse.ArgumentParser(), [])"
        )
        command = [sys.executable, "-c", code]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            process.stdout.readline()
            process.stdout.close()  # as `head` does
            assert process.stderr.read() == b""
        assert process.returncode == 1

    def test_warnings_are_one_line(self, capsys):
        import warnings

        assert (
            program(lambda args: warnings.warn("photos overlap little", UserWarning, stacklevel=1))
            == 0
        )
        assert capsys.readouterr().err == "warning: photos overlap little\n"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--solvr", "heun"], "Unknown option '--solvr': did you mean '--solver'?"),
        (["--solvr=heun"], "did you mean '--solver'?"),
        (["--sol", "heun"], "did you mean '--solver'?"),  # no silent abbreviations
        (["--solver", "hein"], "did you mean 'heun'?"),
        (["--steps", "0"], "'0' is not a whole number of at least 1"),
        (["--steps", "2.5"], "'2.5' is not a whole number"),
        (["--steps"], "expected one argument"),
        (["--rate", "nan"], "'nan' is not a number of at least 0.5"),
        (["--rate", "0.4"], "'0.4' is not a number of at least 0.5"),
        (["stray"], "'stray' belongs to no option"),
        (["--share", "1.5"], "'1.5' is not a number of at least 0 and at most 1"),
    ],
)
def test_wrong_options_are_one_sentence(arguments, said, capsys):
    assert program(lambda args: pytest.fail("must not run"), *arguments) == 2
    shown = capsys.readouterr().err
    assert said in shown and shown.count("\n") == 1 and "usage:" not in shown


def test_right_options_arrive():
    def main(args):
        assert (args.steps, args.rate, args.solver) == (9, 0.75, "heun")

    assert program(main, "--steps", "9", "--rate", "0.75", "--solver=heun") == 0


class TestCache:
    """In processes of their own: the settings are global."""

    def run(self, code, **variables):
        env = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "ROGE_"))}
        call = [sys.executable, "-c", code]
        done = subprocess.run(
            call, env=env | variables, capture_output=True, text=True, timeout=300
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    def test_on_by_default_without_importing_jax(self, tmp_path):
        code = (
            "import os, sys; from roge_jax.files.entry import enable_cache; print(enable_cache());"
            "assert 'jax' not in sys.modules and 'numpy' not in sys.modules;"
            "print(os.environ['JAX_COMPILATION_CACHE_DIR'])"
        )
        returned, variable = self.run(code, XDG_CACHE_HOME=str(tmp_path)).split()
        assert returned == variable and returned.startswith(
            str(tmp_path / "roge_jax" / "programs-")
        )

    @pytest.mark.parametrize("early", [True, False])
    def test_programs_are_kept_however_small(self, early, tmp_path):
        lines = ["from roge_jax.files.entry import enable_cache; enable_cache()", "import jax"]
        lines = lines if early else lines[::-1]
        self.run(
            "; ".join([*lines, "jax.jit(lambda x: x + 1)(2.0)"]),
            ROGE_CACHE=str(tmp_path),
            JAX_PLATFORMS="cpu",
        )
        assert any(tmp_path.glob("programs-*/*"))

    def test_processors_that_differ_have_their_own_programs(self, tmp_path, monkeypatch):
        """A machine of the same name without AVX-512 would stop at the first instruction that it lacks."""
        monkeypatch.setenv("ROGE_CACHE", str(tmp_path))
        folders = set()
        for name, flags in (("A", "avx avx512f"), ("A", "avx"), ("B", "avx")):
            for cores in (1, 2):  # of any number and speed at the moment
                core = f"processor\t: 0\nmodel name\t: {name}\ncpu MHz\t: {cores}\nflags\t\t: {flags}\n"
                monkeypatch.setattr(entry.Path, "exists", lambda file: True)
                monkeypatch.setattr(
                    entry.Path, "read_text", lambda file, encoding, said=cores * core: said
                )
                folders.add(entry.cache_folder())
        assert len(folders) == 3

    def test_can_be_turned_off_and_jax_setting_wins(self, tmp_path):
        code = "from roge_jax.files.entry import enable_cache; print(enable_cache())"
        assert self.run(code, ROGE_CACHE="off").strip() == "None"
        mine = {"ROGE_CACHE": str(tmp_path), "JAX_COMPILATION_CACHE_DIR": "/elsewhere"}
        assert self.run(code, **mine).strip() == "None"
        assert not any(tmp_path.iterdir())


class TestOutputFolder:
    def left(self, tmp_path):
        return sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*"))

    def test_appears_when_complete(self, tmp_path):
        out = tmp_path / "deep" / "out"
        with output_folder(out) as folder:
            (folder / "a").write_text("1")
            assert not out.exists()
        assert self.left(tmp_path) == ["deep", "deep/out", "deep/out/a"]

    def test_earlier_run_survives_a_failure_and_is_replaced_by_success(self, tmp_path):
        out = tmp_path / "out"
        with output_folder(out) as folder:
            (folder / "run.json").write_text("{}")
            (folder / "old").write_text("")
        with pytest.raises(KeyboardInterrupt), output_folder(out) as folder:
            (folder / "half").write_text("")
            raise KeyboardInterrupt
        assert self.left(tmp_path) == ["out", "out/old", "out/run.json"]
        (tmp_path / "out.part").mkdir()  # what a killed run leaves
        (tmp_path / "out.part" / "stale").write_text("")
        with output_folder(out) as folder:
            (folder / "new").write_text("")
        assert self.left(tmp_path) == ["out", "out/new"]

    def test_an_earlier_run_is_there_until_the_new_one_has_its_name(self, tmp_path, monkeypatch):
        old, new = tmp_path / "out", tmp_path / "out.part"
        for folder in (old, new):
            folder.mkdir()
            (folder / "run.json").write_text(folder.name)

        def lost(*_):
            raise KeyboardInterrupt  # or the power goes

        monkeypatch.setattr(type(new), "replace", lost)
        with pytest.raises(KeyboardInterrupt):
            put(new, old)
        assert {file.read_text() for file in tmp_path.rglob("run.json")} == {"out", "out.part"}

    def test_the_room_that_a_run_has_taken_is_not_asked_for_again(self, tmp_path, monkeypatch):
        with (tmp_path / "shard").open("wb") as file:
            file.write(bytes(1_000_000))
            file.flush()
            os.fsync(file.fileno())
        taken, usage = 512 * (tmp_path / "shard").stat().st_blocks, shutil.disk_usage(tmp_path)
        assert taken >= 1_000_000
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1000))
        check_disk(taken + 1000, tmp_path / "new" / "folder", held=[tmp_path])
        for needed, held in ((taken + 1001, [tmp_path]), (taken + 1000, [])):
            with pytest.raises(UserError, match="make room or give another --out"):
                check_disk(needed, tmp_path / "new", held=held)

    def test_two_runs_do_not_share_a_folder(self, tmp_path):
        with output_folder(tmp_path / "out") as folder:
            (folder / "run.json").write_text("{}")
            with (
                pytest.raises(UserError, match="is being written by another run"),
                output_folder(tmp_path / "out"),
            ):
                pass
        assert self.left(tmp_path) == ["out", "out/run.json"]

    def test_links_stay_links(self, tmp_path):
        (tmp_path / "real").mkdir()
        for name, target in (("link", "real"), ("early", "later")):
            (tmp_path / name).symlink_to(target)
            with output_folder(tmp_path / name) as folder:
                (folder / "a").write_text("1")
            assert (tmp_path / name).is_symlink() and (tmp_path / target / "a").exists()
        assert not list(tmp_path.glob("*.part")) + list(tmp_path.glob("*.old"))

    @pytest.mark.parametrize("name", ["/", "x" * 300, "loop", "a\0b"])
    def test_names_that_no_folder_can_have(self, name, tmp_path):
        (tmp_path / "loop").symlink_to("loop")
        with pytest.raises(UserError, match=r"^--out "), output_folder(tmp_path / name):
            pass

    @pytest.mark.parametrize("name", ["folder.png", "file/x.png", "x.txt", "x" * 300 + ".png"])
    def test_files_that_cannot_be_written(self, name, tmp_path):
        (tmp_path / "folder.png").mkdir()
        (tmp_path / "file").write_text("")
        with pytest.raises(UserError, match=r"^--sheet "):
            output_file(tmp_path / name, "--sheet", ".png")
        assert output_file(tmp_path / "new" / "x.png", "--sheet", ".png").parent.is_dir()

    def test_a_run_is_continued_with_its_own_settings(self, tmp_path):
        keep_settings(tmp_path, {"seed": 1}, begun=False, resume=True)
        keep_settings(tmp_path, {"seed": 1, "new": 3}, begun=True, resume=True)
        keep_settings(tmp_path, {"seed": 2}, begun=True, resume=False)  # refused elsewhere
        with pytest.raises(UserError, match="holds a run with seed 1, and 2 is asked for"):
            keep_settings(tmp_path, {"seed": 2}, begun=True, resume=True)
        assert json.loads((tmp_path / "settings.json").read_text()) == {"seed": 1}
        keep_settings(tmp_path, {"seed": 2}, begun=False, resume=False)
        assert json.loads((tmp_path / "settings.json").read_text()) == {"seed": 2}

    def test_foreign_folders_and_files_are_not_touched(self, tmp_path):
        (tmp_path / "thesis.tex").write_text("precious")
        (tmp_path / "file").write_text("")
        with (
            pytest.raises(UserError, match=r"not of an earlier run"),
            output_folder(tmp_path),
        ):
            pass
        with pytest.raises(UserError, match="is a file"), output_folder(tmp_path / "file"):
            pass
        with (
            pytest.raises(UserError, match="cannot be written"),
            output_folder(tmp_path / "file" / "x"),
        ):
            pass
        assert self.left(tmp_path) == ["file", "thesis.tex"]


class TestRecord:
    def test_stages_add_up_and_survive_errors(self):
        clock = entry.Clock()
        for _ in range(2):
            with clock("a"):
                pass
        with pytest.raises(ZeroDivisionError), clock("b"):
            _ = 1 / 0
        record = clock.record()
        assert list(record) == ["a", "b", "total"]
        assert record["total"]["seconds"] >= record["a"]["seconds"] + record["b"]["seconds"] - 0.002
        # This process holds at least the interpreter and NumPy, and less than a big machine.
        assert 0.02 < record["total"]["peak_memory_gb"] < 100

    def test_peak_memory_is_in_gigabytes(self, monkeypatch):
        said = "VmPeak:\t  9000000 kB\nVmHWM:\t  2000000 kB\nVmRSS:\t  1000000 kB\n"
        monkeypatch.setattr(entry.Path, "exists", lambda file: True)
        monkeypatch.setattr(entry.Path, "read_text", lambda file, encoding: said)
        assert entry.peak_memory()["peak_memory_gb"] == 2.048

    def test_environment_names_versions_and_commit(self):
        import jax

        found = entry.environment()
        assert found["versions"]["jax"] == jax.__version__
        assert found["device"]["backend"] == jax.default_backend()
        assert found["commit"] is None or len(found["commit"].removesuffix("-dirty")) >= 7

    def test_no_commit_outside_a_checkout(self, tmp_path):
        assert entry.git_commit(tmp_path) is None

    def test_json_is_strict_and_whole(self, tmp_path):
        import numpy as np

        file = tmp_path / "new" / "run.json"
        write_json(
            file,
            {"a": float("nan"), "b": np.float32(0.5), "c": np.eye(2), "d": (tmp_path, 1), 3: None},
        )
        content = json.loads(file.read_text(), parse_constant=pytest.fail)
        assert content == {
            "a": None,
            "b": 0.5,
            "c": [[1, 0], [0, 1]],
            "d": [str(tmp_path), 1],
            "3": None,
        }
        with pytest.raises(TypeError):
            write_json(file, {"a": object()})
        assert json.loads(file.read_text()) == content and list(file.parent.iterdir()) == [file]


CHECK = "import sys; from roge_jax import check; sys.exit(check.cli(sys.argv[1:]))"
NO_USER = "import pwd\ndef none(uid): raise KeyError(uid)\npwd.getpwuid = none\n"


def checked(tmp_path, folder, code=CHECK, drop=(), **environment):
    """`check` of a small scene in a process of its own with another environment."""
    from scene_files import nerfstudio, truth

    place = nerfstudio(tmp_path / folder, truth(2))
    kept = {k: v for k, v in os.environ.items() if k not in drop} | environment
    command = [sys.executable, "-c", code, str(place), "--no-matching"]
    return subprocess.run(command, env=kept, capture_output=True, check=False)


@pytest.mark.parametrize(
    ("name", "encoding"),
    [("\u5199\u771f", "cp1252"), ("caf\udce9", "utf-8:strict"), ("\u00e9", "ascii")],
)
def test_names_that_the_terminal_cannot_show_are_escaped(tmp_path, name, encoding):
    done = checked(tmp_path, name, PYTHONIOENCODING=encoding)
    assert done.returncode == 0 and b"Traceback" not in done.stderr
    assert b"can be used" in done.stdout and b"\\" in done.stdout


def test_a_user_without_a_home_has_no_cache(tmp_path):
    drop = ("HOME", "ROGE_CACHE", "XDG_CACHE_HOME", "JAX_COMPILATION_CACHE_DIR")
    done = checked(tmp_path, "scene", NO_USER + CHECK, drop)
    assert done.returncode == 0 and b"Traceback" not in done.stderr


@pytest.mark.parametrize("platform", ["cuda", "bogus"])
@pytest.mark.parametrize("call", ["devices", "default_backend"])
def test_a_platform_that_is_not_there_is_one_sentence(platform, call):
    code = (
        "import argparse\nfrom roge_jax.files import entry\n"
        f"def main(args):\n    import jax\n    jax.{call}()\n"
        "entry.run(main, argparse.ArgumentParser(), [])\n"
    )
    environment = os.environ | {"JAX_PLATFORMS": platform}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert f"JAX_PLATFORMS={platform}: JAX finds no such device here" in done.stderr
