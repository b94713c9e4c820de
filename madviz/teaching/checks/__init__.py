"""Exercises that check themselves: a cell says what is right, what is missing, and helps in steps.

In a notebook. An exercise is three cells after its text, known by their tags:

    answer     what a student writes in; it is handed out with a start that answers nothing
    solution   the same names, answered; code and words. A student's copy does not have it
    check      one line, which takes the names:  teaching.check("02.mean", mean)

``prediction`` is a fourth tag, for the questions before an experiment; nothing checks them.

What a check does. It raises ``NotYet`` as long as the answer is missing or wrong, so *Run All*
stops at the first exercise without an answer. The message has no traceback: what is missing in
plain words, and a hint; the next of the three hints comes each time the check fails again, and
``teaching.check("02.mean", mean, hint=2)`` shows two of them at once. No message has the answer.

    02.mean: with no camera present the result has to be zeros
    Hint 1 of 3: How many cameras are present?

Where the answer is right, the cell shows a ``Result``. For a program there is ``judge``: the same
without hints, without counting, and without raising; what a student's code raises is in ``error``.

    judge("02.mean", lambda features, present: 0)
    Result(name="02.mean", passed=False, missing="...", empty=False, error="", hints=())

Names. ``CHECKS`` has every check by its name: the number of its lesson, a dot, a word. ``takes``
are the names that its cell passes, and ``cell`` is that cell's text:

    CHECKS["02.mean"].takes  ->  ("mean",)
    of_lesson("02_merge")    ->  [CHECKS["02.merge"], CHECKS["02.mean"]]

A new check is a function in ``lesson_NN.py``. Its parameters are the names of the cell. It needs no
simulator: functions are called with arrays of its own, numbers and words are compared. It raises
``Missing`` with a sentence, or returns nothing where all is right.
"""

from madviz.teaching.checks.check_table import CHECKS as CHECKS
from madviz.teaching.checks.check_table import check as check
from madviz.teaching.checks.check_table import judge as judge
from madviz.teaching.checks.check_table import of_lesson as of_lesson
from madviz.teaching.checks.exercise import Exercise as Exercise
from madviz.teaching.checks.exercise import NotYet as NotYet
from madviz.teaching.checks.exercise import Result as Result
