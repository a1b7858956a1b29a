"""Notebooks and readers in other languages: what they use is there."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import h5py
import numpy as np
import pytest

import wavefocus
from tests.system.lines import python
from tests.unit.test_bank_writer import measured

DOCS = Path(__file__).parents[2] / "docs"
FOLDER = DOCS / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.py"))


def test_every_notebook_is_in_the_table_of_its_folder():
    page = (FOLDER / "README.md").read_text(encoding="utf-8")
    assert not [notebook.name for notebook in NOTEBOOKS if f"]({notebook.name})" not in page]


@pytest.mark.nightly
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_twice_without_a_warning_and_saves_its_pictures(notebook, tmp_path):
    environment = os.environ | {"FOLDER": str(tmp_path / "out"), "MPLBACKEND": "Agg", "OMP_NUM_THREADS": "1"}
    for _ in range(2):
        done = python("-W", "always", notebook, cwd=tmp_path, env=environment)
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
    pictures = re.findall(r'savefig\(folder / "(.+?)"', notebook.read_text(encoding="utf-8"))
    assert pictures
    assert all((tmp_path / "out" / name).stat().st_size > 5000 for name in pictures)


READERS = sorted(path.name for path in (DOCS / "readers").iterdir())
# MATLAB's functions, which order dimensions as those of Octave's netcdf package do.
MATLAB_IN_OCTAVE = """
function data = h5read(file, name, varargin)
  pkg load netcdf
  data = ncread(file, name(2:end), varargin{:});
end
function value = h5readatt(file, place, name)
  if strcmp(name, 'response_unit'), value = 'm/s/V'; else value = ncreadatt(file, place, name); end
end
"""
PRINT = """
1;
{functions}
addpath('{readers}');
bank = {reader}('{file}');
printf('%d ', size(bank.green)); printf('\\n');
printf('%.9g ', permute(bank.green, [3 2 1])); printf('\\n');
printf('%.17g ', bank.position_mm'); printf('\\n');
printf('%d ', bank.status); printf('\\n');
printf('%.17g ', [bank.sample_rate_hz, bank.time_s(:)']); printf('\\n');
printf('%.9g ', {one}); printf('\\n');
"""


@pytest.mark.parametrize("name", READERS)
def test_every_reader_has_ten_lines_is_on_its_page_and_reads_names_that_a_bank_has(tmp_path, name):
    text = (DOCS / "readers" / name).read_text(encoding="utf-8")
    page = (DOCS / "how-to" / "read-a-bank-elsewhere.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 10
    assert re.search(rf"<!-- docs/readers/{name} -->\n```\w+\n{re.escape(text)}```\n", page)
    names = set(re.findall(r"""['"]/?(\w+)['"]""", text))
    with h5py.File(measured(tmp_path / "bank.h5")) as file:
        assert names - {*file, *file.attrs} == set()
    assert {"green", "position_mm", "actuator_mm", "status", "time_s", "sample_rate_hz"} <= names


def octave(script, folder):
    """The lines of numbers that Octave prints."""
    program = shutil.which("octave-cli")
    if program is None:
        pytest.skip("Octave is not installed; on Debian: apt-get install octave octave-netcdf")
    (folder / "show.m").write_text(script, encoding="utf-8")
    done = subprocess.run(
        [program, "--no-gui", "--norc", "show.m"], cwd=folder, capture_output=True, text=True, timeout=100, check=False
    )
    assert done.returncode == 0, done.stderr
    return [np.array(line.split(), float) for line in done.stdout.splitlines()]


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("reader", "functions", "call"), [("octave", "", "ncread"), ("matlab", MATLAB_IN_OCTAVE, "h5read")]
)
def test_octave_reads_a_bank_with_equal_numbers(tmp_path, reader, functions, call):
    bank = measured(tmp_path / "bank.h5")
    page = (DOCS / "how-to" / "read-a-bank-elsewhere.md").read_text(encoding="utf-8")
    (one,) = re.findall(rf"`(squeeze\({call}\(.*)`", page)
    script = PRINT.format(
        functions=functions, readers=DOCS / "readers", reader=f"read_bank_{reader}", file=bank,
        one=one.replace("(file,", f"('{bank}',").replace("701", "3") + "'",
    )  # fmt: skip
    lines = octave(script, tmp_path)
    with h5py.File(bank) as file:
        green = file["green"][...]
        assert lines[0].tolist() == list(green.shape)
        assert np.array_equal(lines[1].astype(np.float32), green.ravel())
        assert np.array_equal(lines[2], file["position_mm"][...].ravel())
        assert np.array_equal(lines[3], file["status"][...])
        assert np.array_equal(lines[4], [file.attrs["sample_rate_hz"], *file["time_s"][...]])
        assert np.array_equal(lines[5].astype(np.float32), green[2].ravel())


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("to", "read"),
    [
        ("mat", "b = load('{file}'); green = b.green; places = b.position_mm;"),
        (
            "netcdf",
            "pkg load netcdf; green = permute(ncread('{file}', 'green'), [3 2 1]);"
            " places = ncread('{file}', 'position_mm')';",
        ),
    ],
)
def test_octave_reads_an_export_with_equal_numbers(tmp_path, to, read):
    bank, file = measured(tmp_path / "bank.h5"), tmp_path / f"bank.{to}"
    wavefocus.export_bank(bank, file, to, positions=[2, 0])
    show = "printf('%.9g ', permute(green, [3 2 1])); printf('\\n'); printf('%.17g ', places'); printf('\\n');"
    green, places_mm = octave(f"1;\n{read.format(file=file)}\n{show}\n", tmp_path)
    with h5py.File(bank) as held:
        assert np.array_equal(green.astype(np.float32), held["green"][...][[2, 0]].ravel())
        assert np.array_equal(places_mm, held["position_mm"][...][[2, 0]].ravel())
