"""Numbers typed into the window's boxes: into every box where commas separate decimals, into one in other locales."""

import pytest
from PyQt5.QtCore import QEvent, QLocale, Qt
from PyQt5.QtGui import QKeyEvent
from PyQt5.QtTest import QTest
from PyQt5.QtWidgets import QAbstractSpinBox, QApplication, QDoubleSpinBox

from wavefocus.gui.widgets import NumberBox

# Texts, and the number that each is; None for those that are refused.
TYPED = {
    "0.2": 0.2, "0,2": 0.2, ".5": 0.5, ",5": 0.5, "1,5": 1.5, "1.5": 1.5, "0,05": 0.05, "0.05": 0.05, "3": 3.0,
    "1,000": 1.0, "1.000": 1.0, "-1,5": -1.5, "2e0": 2.0, " 2 ": 2.0,
    "1,234.5": None, "1.234,5": None, "1 000": None, "1'000": None, "1\u00a0000": None, "1\u202f000": None, "1_0": None,
    "": None, "-": None, ",": None, "0,2,": None, "nan": None, "inf": None, "0x10": None, "\u0663": None, "1e": None,
}  # fmt: skip

ONCE_MORE = ("0,2", "3", "1.234,5", "nan")


@pytest.fixture
def locale():
    """Sets the locale of widgets that are made from then on."""
    former = QLocale()
    yield lambda name: QLocale.setDefault(QLocale(name))
    QLocale.setDefault(former)


def type_into(box, text):
    box.selectAll()
    QTest.keyClick(box, Qt.Key.Key_Delete)
    for character in text:  # QTest.keyClicks knows ASCII only
        QApplication.sendEvent(box, QKeyEvent(QEvent.Type.KeyPress, 0, Qt.KeyboardModifiers(), character))
    QTest.keyClick(box, Qt.Key.Key_Return)


def test_given_texts_typed_into_every_box_then_the_value_is_theirs_or_stays(locale, open_window):
    locale("de_DE")
    window = open_window()
    boxes = window.findChildren(QAbstractSpinBox)
    assert sum(bool(tab.findChildren(QAbstractSpinBox)) for tab in window.tabs) >= 2, "all tabs are there, shown or not"
    assert {type(box) for box in boxes if not isinstance(box, NumberBox)} == set()
    typed = set()
    for box in boxes:
        low, high, decimals = box.minimum(), box.maximum(), box.decimals()
        alike = type(box), decimals, low < 0, high < 3, box.prefix() == "", box.suffix() == ""
        texts = ONCE_MORE if alike in typed else TYPED  # one box of each kind gets all of them
        typed.add(alike)
        for text, number in ((text, TYPED[text]) for text in texts):
            former = min(max(7.0, low), high)
            box.setValue(former)
            part = box
            while part is not None:  # a form without a source is disabled
                part.setEnabled(True)
                part = part.parentWidget()
            type_into(box, text)
            fits = number is not None and low <= number <= high and (decimals > 0 or number == int(number))
            expected = number if fits and number is not None else former
            case = (box.accessibleName(), text)
            assert box.value() == pytest.approx(expected, abs=0.5001 * 10.0**-decimals), case
            assert QDoubleSpinBox.value(box) == box.value(), case
            assert box.text() == f"{box.prefix()}{box.textFromValue(box.value())}{box.suffix()}", case


@pytest.mark.parametrize("name", ["C", "en_US", "de_DE"])
def test_given_a_refused_text_then_it_stays_until_the_end_and_nothing_is_reported(qtbot, locale, name):
    locale(name)
    box, values = NumberBox(3, 0.001, 4.0, suffix=" V"), []
    qtbot.addWidget(box)
    box.setValue(0.5)
    box.valueChanged.connect(values.append)
    box.selectAll()
    QTest.keyClicks(box, "1,234.5 V")
    assert box.text().startswith("1,234.5")  # a text without some of its keys would be another number
    QTest.keyClick(box, Qt.Key.Key_Tab)
    box.clearFocus()
    assert (box.value(), values) == (0.5, [])
    type_into(box, "10")  # larger than the box allows: not 1
    assert (box.value(), values) == (0.5, [])
    box.selectAll()
    QTest.keyClicks(box, "0,25")
    assert values == []
    assert (box.value(), values) == (0.25, [0.25])  # used by a key, F5, before it was finished
