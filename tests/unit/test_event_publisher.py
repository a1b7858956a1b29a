"""A subscriber that fails: reported once, and neither the others nor the campaign notice."""

from tests.lab_files import write_positions
from wavefocus.acquisition.engine.campaign import Campaign
from wavefocus.acquisition.engine.session import StopRequest
from wavefocus.campaign.blueprint import blueprint_from_files
from wavefocus.campaign.sidecar_files import EventLines
from wavefocus.config.messages.campaign import Event, State
from wavefocus.rig.setup import open_setup
from wavefocus.storage.bank.writer import BankWriter, create_bank

RUN = """
rig = "virtual"
[grid]
positions_file = "positions.csv"
[sweep]
duration_s = 0.3
[capture]
decay_s = 0.1
taps = 500
"""


class Fails:
    def __init__(self, failure):
        self.failure = failure
        self.calls = 0

    def __call__(self, event):
        self.calls += 1
        raise self.failure


def test_given_a_closed_file_then_event_lines_end_and_say_so(tmp_path, capsys):
    with (tmp_path / "lines").open("w", encoding="utf-8") as file:
        pass
    lines = EventLines(file.write, "standard output")
    lines(Event(0.0))
    lines(Event(1.0))
    assert capsys.readouterr().err.count("standard output cannot be written any more") == 1


def test_a_subscriber_of_the_campaign_that_fails_then_every_position_is_measured(tmp_path, caplog):
    (tmp_path / "run.toml").write_text(RUN, encoding="utf-8")
    write_positions(tmp_path, [(0, 0), (4, 0)])
    blueprint = blueprint_from_files(tmp_path / "run.toml")
    bank = tmp_path / "plate.h5"
    create_bank(bank, blueprint.bank_header())
    failing = Fails(ValueError("I/O operation on closed file"))
    with (
        BankWriter.open(bank, plan_sha256=blueprint.plan.sha256) as writer,
        open_setup(blueprint.configuration.rig, blueprint.configuration.run) as setup,
    ):
        ended = Campaign(blueprint.plan, setup, writer, failing, StopRequest()).run()
    assert ended.state is State.FINISHED
    assert ended.done == blueprint.plan.positions
    assert failing.calls > blueprint.plan.positions
    assert len([record for record in caplog.records if "closed file" in record.message]) == 1
