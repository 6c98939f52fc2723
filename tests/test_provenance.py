"""What a result depends on is recorded, and can be made not to matter."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from conftest import quick_options, settings

from sofnn_torch import training
from sofnn_torch.runs import provenance
from sofnn_torch.studies import running

ROOT = Path(__file__).parents[1]
# Products of matrices, as in replay, and a firing strength: their sums depend on the processor.
COMPUTE = """
import sys
from sofnn_torch.runs.provenance import make_portable, torch, versions
if "portable" in sys.argv:
    make_portable()
x, w = torch.linspace(-3, 3, 64 * 700).reshape(64, 700), torch.linspace(1, 2, 7 * 700)
firing = x.square().mul(-0.5).exp()
numbers = (firing / firing.sum(1, keepdim=True)) @ w.reshape(700, 7)
print(versions()["instructions"], numbers.numpy().tobytes().hex())
"""


def compute(*arguments, **environment):
    """Instructions and bits of a small computation in a process of its own."""
    kept = {k: v for k, v in os.environ.items() if k not in provenance.PORTABLE}
    environment = kept | {"PYTHONPATH": str(ROOT)} | environment
    command = [sys.executable, "-c", COMPUTE, *arguments]
    return subprocess.run(
        command, env=environment, capture_output=True, text=True, check=True
    ).stdout.split()


@pytest.mark.slow
@pytest.mark.skipif(not torch.cpu._is_avx2_supported(), reason="needs AVX2")
def test_portable_bits_do_not_depend_on_the_instructions_and_others_do():
    one, other = {"ATEN_CPU_CAPABILITY": "default"}, {"MKL_CBWR": "AUTO"}
    instructions, bits = compute("portable", **one)
    assert instructions == "AVX2"
    assert [instructions, bits] == compute("portable", **other)
    instructions, others = compute(**one)
    assert instructions == "DEFAULT" and others != bits


def test_portable_comes_too_late_once_torch_has_computed(monkeypatch):
    monkeypatch.setattr(torch.cpu, "_is_avx2_supported", lambda: True)
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX512")
    for name in provenance.PORTABLE:
        monkeypatch.setenv(name, "")  # put back afterwards
    with pytest.raises(ValueError, match="start with ATEN_CPU_CAPABILITY=avx2 MKL_CBWR=COMPAT"):
        provenance.make_portable()


def test_portable_needs_avx2(monkeypatch):
    monkeypatch.setattr(torch.cpu, "_is_avx2_supported", lambda: False)
    with pytest.raises(ValueError, match="needs a processor with AVX2"):
        provenance.make_portable()


@pytest.mark.parametrize(
    ("text", "branch", "blas"),
    [
        ("  - Intel(R) oneAPI Math Kernel Library Version 2024.2-Product Build", "", "MKL 2024.2"),
        ("Math Kernel Library Version 2024.2-Product", "AVX2", "MKL 2024.2-Product, AVX2"),
        ("Build settings: BLAS_INFO=open, LAPACK_INFO=open", "", "open"),
        ("", "", "unknown"),
    ],
)
def test_the_library_of_matrix_products_is_named_with_its_branch(text, branch, blas, monkeypatch):
    monkeypatch.setattr(torch.__config__, "show", lambda: text)
    monkeypatch.setenv("MKL_CBWR", branch)
    assert provenance._blas.__wrapped__().startswith(blas)


def test_versions_name_the_instructions_and_what_becomes_of_denormal_numbers():
    flushed = []
    for flush in (True, False):
        torch.set_flush_denormal(flush)
        flushed.append(provenance.versions()["denormals"])
    assert flushed == ["flushed", "kept"]
    assert provenance.versions()["instructions"] == torch.backends.cpu.get_cpu_capability()
    assert len(provenance.versions()["processor"]) > 2


def test_a_run_that_goes_on_elsewhere_says_so_in_one_line(quick, options, monkeypatch, capsys):
    path = training.train(quick(trials=1), options)
    recorded = json.loads((path / "config.json").read_text())
    assert recorded["versions"]["instructions"] == torch.backends.cpu.get_cpu_capability()
    assert recorded["versions"]["denormals"] == "flushed"
    del recorded["versions"]["blas"]  # as in runs of earlier versions
    (path / "config.json").write_text(json.dumps(recorded))
    here = recorded["versions"] | {"blas": "B", "instructions": "AVX7", "processor": "P"}
    monkeypatch.setattr(provenance, "versions", lambda: here)
    training.resume(path, options, trials=2)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("warning: ") and line.endswith(": numbers may differ in the last bits")
    now = torch.backends.cpu.get_cpu_capability()
    assert f"instructions was {now}, is AVX7" in line and "blas was unknown, is B" in line
    assert "torch" not in line
    training.resume(path, options, trials=3)
    assert not capsys.readouterr().err


def test_studies_name_the_machine_that_played_beside_the_one_that_trained(tmp_path, monkeypatch):
    for here in ("A", "B", "B"):
        monkeypatch.setattr(running, "versions", lambda here=here: {"instructions": here})
        running._note_versions(tmp_path / running.PLAYED)
    assert json.loads((tmp_path / running.PLAYED).read_text()) == [
        {"instructions": "A"},
        {"instructions": "B"},
    ]


def test_comments_and_docstrings_are_no_code():
    bare = '''"""Say."""
def f(x):
    """Do."""
    # as Kimura does
    return x + 1
class A:
    """Only this."""
'''
    assert provenance._bare(bare) == provenance._bare("def f(x): return x + 1\nclass A:\n    pass")
    assert provenance._bare(bare) != provenance._bare(bare.replace("+ 1", "+ 2"))


def test_the_fingerprint_is_of_what_decides_and_of_the_mazes(monkeypatch):
    seen = []
    monkeypatch.setattr(provenance, "_bare", lambda source: seen.append(source) or "")
    provenance.code.cache_clear()
    provenance.code()
    package = ROOT / "sofnn_torch"
    for name in ("network/sofnn.py", "learners/sga.py", "maze/sensors.py", "training.py"):
        assert (package / name).read_text() in seen
    for name in ("maze/viewer.py", "plot.py", "studies/report.py"):
        assert (package / name).read_text() not in seen
    provenance.code.cache_clear()


def test_a_run_whose_versions_are_lost_goes_on(tmp_path):
    config = settings(trials=1)
    run = training.train(config, quick_options(tmp_path, name="run"))
    file = run / "config.json"
    kept = json.loads(file.read_text())
    del kept["versions"]
    file.write_text(json.dumps(kept))
    training.resume(run, quick_options(tmp_path), trials=2)
    assert json.loads(file.read_text())["versions"]["torch"] == torch.__version__
