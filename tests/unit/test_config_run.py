import re

import numpy as np
import pytest

from wavefocus.config.rig import default_rig
from wavefocus.config.run import RunConfig, default_run
from wavefocus.configuration import check_together, configuration_from_json, load_run, plan_sha256
from wavefocus.storage.errors import InputError

POSITIONS = np.array([[0.0, 0.0], [4.0, 0.0]])


def write(folder, text, name="run.toml"):
    file = folder / name
    file.write_text(text, encoding="utf-8")
    return file


def complaint_about(file):
    with pytest.raises(InputError) as told:
        load_run(file)
    message = str(told.value)
    assert message.isprintable()  # one line
    return message


def test_empty_run_file_is_the_default_campaign(tmp_path):
    configuration = load_run(write(tmp_path, ""))
    assert configuration.run == default_run()
    assert configuration.rig == default_rig()
    assert configuration.position_mm.shape == (1500, 2)
    capture = configuration.run.capture
    assert (capture.averages, capture.taps, capture.decay_s, capture.stagger_s) == (3, 2000, 0.2, 0.25)


MISTAKES = [
    ("[virtual]\nplate = 'thin'", 'virtual.plate = "thin": needs kind = "rectangle"'),
    ("[virtual]\nquality = 3", 'virtual.quality = 3.0: belongs to plate = "thin"'),
    ("[grid]\nspacing_m = 4", "grid.spacing_m = 4: unknown key; did you mean spacing_mm?"),
    ("[grid]\ntaps = 4", "grid.taps = 4: unknown key; it belongs to [capture]"),
    ("[grid]\ncolour = 4", "grid.colour = 4: unknown key; allowed: lattice, spacing_mm, margin_mm, positions_file"),
    ("taps = 4", "taps = 4: unknown key; it belongs to [capture]"),
    ("[gird]\nspacing_mm = 4", "gird = { spacing_mm }: unknown key; did you mean grid?"),
    ("grid = 4", "grid = 4: must be a table"),
    ("[grid]\nspacing_mm = 0", "grid.spacing_mm = 0: must be above 0"),
    ("[grid]\nspacing_mm = nan", "grid.spacing_mm = nan: must be a finite number"),
    ("[grid]\nspacing_mm = '4'", 'grid.spacing_mm = "4": must be a number'),
    ("[grid]\nspacing_mm = true", "grid.spacing_mm = true: must be a number"),
    ("[grid]\nspacing_mm = 1e-6", "grid.spacing_mm = 1e-06: gives more than 1,000,000 positions"),
    ("[grid]\nspacing_mm = 1e6", "grid.spacing_mm = 1e+06: leaves no position"),
    ("[grid]\nmargin_mm = 75", "grid.margin_mm = 75: leaves no position"),
    ("[grid]\nmargin_mm = -1", "grid.margin_mm = -1: must be at least 0"),
    ("[grid]\npositions_file = 'x.csv'", 'grid.positions_file = "x.csv": must be a file'),
    ("[sweep]\nstart_hz = 0", "sweep.start_hz = 0: must be above 0"),
    ("[sweep]\nstop_hz = 5000", "sweep.stop_hz = 5000.0: must be below 5000 (half of capture.sample_rate_hz)"),
    ("[sweep]\nstop_hz = 20", "sweep.stop_hz = 20.0: must be above start_hz = 20"),
    ("[sweep]\nduration_s = 0", "sweep.duration_s = 0: must be at least 0.05"),
    ("[sweep]\namplitude_v = 5.1", "sweep.amplitude_v = 5.1: must be at most player.limit_v = 5 of the rig"),
    ("[capture]\naverages = 0", "capture.averages = 0: must be at least 1"),
    ("[capture]\naverages = 2.5", "capture.averages = 2.5: must be a whole number"),
    ("[capture]\ntaps = 2001", "capture.taps = 2001: must be at most 2000 (decay_s * sample_rate_hz)"),
    ("[capture]\ndecay_s = 0.1", "capture.taps = 2000: must be at most 1000 (decay_s * sample_rate_hz)"),
    ("[capture]\nsample_rate_hz = 0", "capture.sample_rate_hz = 0: must be above 0"),
    ("[capture]\nstagger_s = 0.239", "capture.stagger_s = 0.239: must be at least 0.24 (1.2 times the response"),
    ("[capture]\ngroups = 21", "capture.groups = 21: must be at most 20, the number of actuators"),
    ("[capture]\nlevel_db = 1", "capture.level_db = 1: must be at most 0"),
    ("[settled]\nreason = 'a'", "settled: comes from the trial before a staggered campaign"),
    ("[capture]\nexcitation = 'all'", 'capture.excitation = "all": must be "sequential" or "staggered"'),
    ("[capture]\nkeep_raw = 1", "capture.keep_raw = 1: must be true or false"),
    ("[quality]\nmax_attempts = 0", "quality.max_attempts = 0: must be at least 1"),
    ("[tolerance]\ncorrelation = 1.1", "tolerance.correlation = 1.1: must be at most 1"),
    ("[drift]\nstop_level_db = 0.1", "drift.stop_level_db = 0.1"),
    ("[drift]\nstop_delay_samples = 0.1", "drift.stop_delay_samples = 0.1"),
    ("[drift]\nstop_correlation = 0.99", "drift.stop_correlation = 0.99"),
    ("[drift]\nevery_positions = 0", "drift.every_positions = 0"),
    ("[drift]\nevery_s = 0", "drift.every_s = 0"),
    ("[virtual]\nroom_c = [[5, 20], [1, 21]]", "virtual.room_c"),
    ("[virtual]\nfinger = { place_mm = [0, 73] }", "virtual.finger.place_mm = [0, 73]: must be on the surface, 3 mm"),
    ("[virtual]\nseed = -1", "virtual.seed = -1: must be at least 0"),
    ("[virtual]\nnoise_v = -1", "virtual.noise_v = -1: must be at least 0"),
    ("[virtual]\nfault_plan = 'f.toml'", 'virtual.fault_plan = "f.toml": must be a file'),
    ("[[virtual.fault_plan]]\nrole = 'player'", "virtual.fault_plan[0].operation: is missing"),
    (
        "[[virtual.fault_plan]]\nrole = 'laser'\noperation = 'read'\nkind = 'lost'\nposition = 1",
        "virtual.fault_plan[0] = { role, operation, kind, position }: fault role is 'laser'; allowed: mirror",
    ),
    ("rig = 'lab.toml'", 'rig = "lab.toml": must be a file'),
    ("rig = ''", 'rig = "": must not be empty'),
    ("rig = 3", "rig = 3: must be text in quotes"),
    ("rig = \n", "not TOML: Invalid value (at line 1, column 7)"),
    ("a = " + "[" * 50_000, "not TOML"),
    ("a = " + "9" * 50_000, "not TOML"),
]


@pytest.mark.parametrize(("text", "complaint"), MISTAKES, ids=[complaint[:40] for _, complaint in MISTAKES])
def test_mistake_in_a_run_file_is_one_line_with_file_key_value_and_what_is_allowed(tmp_path, text, complaint):
    file = write(tmp_path, text)
    assert complaint_about(file).startswith(f"{file}: {complaint}")


def test_several_mistakes_are_told_in_one_line_and_counted(tmp_path):
    file = write(tmp_path, "[grid]\nspacing_mm=0\nmargin_mm=-1\n[sweep]\nstart_hz=0\nstop_hz=0\nduration_s=0\n")
    assert complaint_about(file) == (
        f"{file}: grid.spacing_mm = 0: must be above 0; grid.margin_mm = -1: must be at least 0; "
        "sweep.start_hz = 0: must be above 0; and 2 more"
    )


def test_control_characters_in_names_and_values_stay_in_one_line(tmp_path):
    file = write(tmp_path, 'rig = "a\\nb.toml"\n', name="run\n1.toml")
    assert complaint_about(file).startswith(f'{tmp_path}/run\\n1.toml: rig = "a\\nb.toml"')


@pytest.mark.parametrize("name", ["missing.toml", "", "x" * 300])
def test_run_file_that_is_no_file_is_told_by_name(tmp_path, name):
    assert complaint_about(tmp_path / name).startswith(f"{tmp_path / name}: ")


def test_run_file_that_is_not_utf8_is_told_with_the_line(tmp_path):
    file = tmp_path / "run.toml"
    file.write_bytes("# für\nrig = 'ü'\n".encode("latin-1"))
    assert complaint_about(file) == f"{file}: line 1: not UTF-8 text; save the file as UTF-8"


def test_position_outside_the_surface_names_the_line_of_its_file(tmp_path):
    positions = write(tmp_path, "x_mm,y_mm\n0,0\n130,0\n", name="grid.csv")
    file = write(tmp_path, "[grid]\npositions_file = 'grid.csv'")
    assert complaint_about(file).startswith(f"{positions}: line 3: (130, 0) mm lies outside the surface")


def test_positions_file_takes_the_place_of_the_grid(tmp_path):
    write(tmp_path, "x_mm,y_mm\n0,0\n4,0\n", name="grid.csv")
    configuration = load_run(write(tmp_path, "[grid]\npositions_file = 'grid.csv'\nspacing_mm = 8"))
    assert configuration.position_mm.tolist() == [[0, 0], [4, 0]]


def test_rig_file_is_found_beside_the_run_file(tmp_path):
    write(tmp_path, "[rig]\nname = 'bench'", name="rig.toml")
    assert load_run(write(tmp_path, "rig = 'rig.toml'")).rig.rig.name == "bench"


def test_mistake_in_the_named_rig_names_the_rig_file(tmp_path):
    rig = write(tmp_path, "[surface]\nwidth_mm = 0", name="rig.toml")
    file = write(tmp_path, "rig = 'rig.toml'")
    assert complaint_about(file) == f"{rig}: surface.width_mm = 0: must be above 0"


def test_grid_that_the_mirror_cannot_reach_is_refused_with_the_angle(tmp_path):
    write(tmp_path, "[mirror]\nlimit_mrad = 100\npark_mrad = [0, 0]", name="rig.toml")
    complaint = complaint_about(write(tmp_path, "rig = 'rig.toml'"))
    assert "grid: position " in complaint
    assert complaint.endswith("mrad; the rig's mirror.limit_mrad = 100")


def test_amplitude_beyond_the_reference_input_is_refused(tmp_path):
    write(tmp_path, "[recorder]\nreference_range_v = 1\nreference_gain = 2", name="rig.toml")
    complaint = complaint_about(write(tmp_path, "rig = 'rig.toml'"))
    assert "sweep.amplitude_v = 1: must be at most 0.5" in complaint


def test_virtual_settings_for_a_rig_with_other_drivers_are_refused():
    rig = default_rig()
    wired = rig.model_copy(update={"mirror": rig.mirror.model_copy(update={"driver": "generic"})})
    run = RunConfig.model_validate({"virtual": {"seed": 2}})
    with pytest.raises(InputError, match=r"run\.toml: virtual: is only for a virtual rig"):
        check_together(run, wired, "run.toml")


def test_fault_plan_file_becomes_part_of_the_run(tmp_path):
    write(tmp_path, "[[fault]]\nrole='recorder'\noperation='read'\nkind='short_read'\nposition=3\n", name="f.toml")
    run = load_run(write(tmp_path, "[virtual]\nfault_plan = 'f.toml'")).run
    assert run.virtual is not None
    assert [(fault.role, fault.position) for fault in run.virtual.fault_plan] == [("recorder", 3)]
    assert RunConfig.model_validate_json(run.model_dump_json()) == run


@pytest.mark.parametrize("text", ["", "[capture]\ntaps = 3000\ndecay_s = 0.3\n[virtual]\nnoise_v = 1e-3"])
def test_configuration_survives_the_bank_and_keeps_its_hash(tmp_path, text):
    there = load_run(write(tmp_path, text))
    back = configuration_from_json(
        there.rig.model_dump_json(), there.run.model_dump_json(), there.position_mm, "bank.h5"
    )
    assert (back.run, back.rig) == (there.run, there.rig)
    assert back.plan_sha256 == there.plan_sha256


@pytest.mark.parametrize("text", ["{", "[]", '{"grid": {"spacing_mm": NaN}}', "[" * 50_000])
def test_bank_with_a_spoilt_configuration_is_told_in_one_line(text):
    with pytest.raises(InputError, match=re.escape("bank.h5: attribute run: ")):
        configuration_from_json(default_rig().model_dump_json(), text, POSITIONS, "bank.h5")


def test_plan_hash_changes_with_a_position():
    moved = POSITIONS + np.array([[0, 0], [0, 1e-9]])
    assert plan_sha256(default_rig(), default_run(), moved) != plan_sha256(default_rig(), default_run(), POSITIONS)
