# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 6. The baselines
#
# **Question: other methods handle several cameras in other ways. Which of them still work when a
# camera is missing?**
#
# Ten methods were trained on `toy/reach`, as in lesson 3 with twice the samples for each update,
# and each was measured with cameras missing in every way, in the same 40 episodes. One of them you
# train yourself. Lesson 7 says how each of them is built, and so why it does what you see here.
#
# Time: 35 minutes. Lesson 3 comes before this one.

# %%
import madviz
from madviz import teaching
from madviz.observation.ablation import Occlusion
from madviz.teaching.baselines import on_robot
from madviz.teaching.lessons import support_table
from madviz.teaching.outcomes import (
    CAMERAS,
    by_seed,
    one_missing,
    outcome_bars,
    outcome_table,
    read_outcomes,
)
from madviz.widgets import Explorer, Predict

teaching.begin()
YOURS = "vib"  # The one that you train; another student may take another.

# %% [markdown]
# ## Ten methods
#
# | method | idea in one sentence |
# |---|---|
# | single | one camera from the start |
# | frame-stack | the pixels of all cameras in one picture with many channels |
# | concat | one feature per camera, side by side |
# | attention, vit | features attend to each other, then are merged |
# | q-mean | every camera has an action and a Q value of its own, and these are averaged |
# | mvd | a part that all cameras share beside a part that is private to one camera |
# | vib | everything but the first camera must pass a noisy bottleneck |
# | merged-only | features are summed |
# | mad | features are summed, and the policy learns to act on each term alone |

# %% tags=["prediction"]
guess = Predict(
    "How many of these can answer at all when one of three cameras is missing?",
    ["All of them", "All but two", "All but three, and Single Camera if it is the wrong one"],
)
guess

# %%
support_table()

# %%
guess.compare("frame-stack and concat need all; VIB has no rule for two of three; Single has one")

# %% [markdown]
# That a method *can* answer does not mean that the answer is good. Merged Only (lesson 3) answers
# to every set, and fails with every set that lacks First person. And those that cannot answer are
# given a black picture for the missing camera. Lesson 4 showed what that is: a picture that the
# policy was not trained on, with a feature of its own.
#
# ## The results
#
# Each method had 600 updates by imitation (lesson 3 says how), with the same seed, and each was
# measured in the same 40 episodes. Single Camera has Third A and nothing else. In the figure a
# camera is missing in the way that suits the method: dropped if its merge allows that, else black.

# %% tags=["prediction"]
guess_first = Predict(
    "First person is missing. Which baseline still succeeds most often? (Single does not count.)",
    ["merged-only", "q-mean", "attention or vit", "mvd", "vib", "concat or frame-stack"],
)
guess_first

# %%
measured = read_outcomes()
measured["mad"]["first black"]  # An episode a digit; 1 is a success.

# %%
best = one_missing(measured)
cases = list(best["mad"])
outcome_bars("success on toy/reach, 40 episodes each (shipped)", best, cases)

# %%
outcome_table(best, cases)

# %%
successes = {name: outcomes["first missing"].count("1") for name, outcomes in best.items()}
winner = max((name for name in best if name not in ("mad", "single")), key=successes.get)
guess_first.compare(f"{winner}, in {teaching.in_words(successes[winner], 40)}")

# %% [markdown]
# All ten work with all their cameras. What they do without First person differs. In this task it is
# the easiest camera to learn from: it is mounted on the hand, and the direction to move in is the
# direction of the orange spot. A method that always has it in training comes to depend on it,
# whatever the merge: a sum, a mean of actions, attention, places side by side. For VIB everything
# else that it uses adds to the loss, so it uses First person alone. MVD draws its cameras, so there
# is often no First person in training, and MAD acts on each camera by itself in every update. Only
# these two were *trained* to do without it.
#
# Is MVD as good as MAD there? Both had the same episodes:

# %%
both = tuple(by_seed(best[name]["first missing"]) for name in ("mad", winner))
teaching.paired_table(("mad", winner), {"first missing": both})

# %% [markdown]
# Five episodes came out differently, all of them for MAD. Five tosses of a coin that come out alike
# happen once in sixteen times, so it is a hint and no proof (lesson 4). And the interval is about
# episodes, not about trainings: there was one of each, and with another seed two results as close
# as these may change places.
#
# ## Dropped, or black
#
# The same camera missing twice: dropped, where a method can do that, and black.

# %%
outcome_table(
    measured, [f"{camera} {how}" for camera in ("first", "third_b") for how in ("dropped", "black")]
)

# %% [markdown]
# Neither is always better: find a method that does better with black, and one that does better
# with the camera dropped. No method was trained on black pictures, and most were never trained on
# two cameras, so both are new to them. A black Third B does VIB no harm, because it hardly uses
# that camera.
#
# ## One camera left

# %%
outcome_table(measured, [f"only {camera}" for camera in CAMERAS])

# %% [markdown]
# ## Train one yourself
#
# `YOURS` at the top says which. Two idle cores need about a minute for VIB, two for MVD and
# attention, less for the others. With the same seed the result is the shipped one, or nearly:
# sums are rounded differently from machine to machine.

# %%
camera = "third_a" if YOURS == "single" else ""
yours = teaching.train_small(YOURS, camera=camera, rounds=6, updates=100)
print(f"\n{YOURS}: {yours.seconds:.0f} s")

# %%
rows = {}
for black in ("", "first", "third_a"):
    occlusions = {black: Occlusion("black")} if black in yours.spec.streams else {}
    result = madviz.evaluate(yours.policy, ["all"], episodes=40, occlusions=occlusions, seed=5000)
    rows[f"{black} black" if black else "all"] = teaching.counts(result.rows)["all"]
shipped = {case: (measured[YOURS][case].count("1"), 40) for case in rows}
teaching.success_table({f"{YOURS}, yours": rows, f"{YOURS}, shipped": shipped})

# %% [markdown]
# ## Play
#
# This is the policy you trained. Send black from one camera, then from another, and see where the
# hand goes.

# %%
explorer = Explorer(yours.policy, seed=2001)
explorer

# %% [markdown]
# ## And on a robot?
#
# Now an arm that pushes a puck (`metaworld/push`). Every method had as many demonstrations and
# 3,600 updates, and the same 50 episodes with all cameras and with each alone (measured before,
# `results/RESULTS.md` has the commands). This is one training of each; six of the methods were
# trained twice more, and other trainings have other rates. Single Camera is three policies here,
# one for each camera, and none of them was trained on another.

# %% tags=["prediction"]
guess_robot = Predict(
    "Only Third A is left. Which method still pushes the puck to its goal most often?",
    [
        "single (it was trained on Third A alone)",
        "singular-only",
        "vib or merged-only",
        "mad or mvd",
    ],
)
guess_robot

# %%
robot = on_robot("metaworld/push")
outcome_table(robot, ["all", *CAMERAS], missing="–")

# %%
alone = {name: found["third_a"].count("1") for name, found in robot.items() if "third_a" in found}
leader = max((name for name in alone if name != "naive-both"), key=alone.get)
guess_robot.compare(f"{leader}, in {teaching.in_words(alone[leader], 50)}")

# %% [markdown]
# What the toy showed is here again: Merged Only, VIB and Q-mean depend on First person, Attention
# has no success with one camera, Concat and Frame Stack refuse (a dash), and MVD, which was trained
# on single cameras too, still succeeds with each of them, but is weak with all cameras. Something
# is new, too. Three networks for three cameras do not solve the problem: from Third A or Third B
# alone Single hardly learns the task at this small budget, while the one network that had all three
# does. Singular Only learned to act on single cameras and never on the sum: with all cameras it is
# weak.
#
# `naive-both` weighs the sum and the single cameras alike. So does MAD here, and with the expert as
# the only teacher the two are then one and the same training: the rows must be equal, and are.
# A method without a row has no measurement. All of this is imitation; the paper compares the
# methods by reinforcement learning, where a policy also has to find out what to do.

# %% [markdown]
# ## Exercise 1: what is lost
#
# Outcomes are text, an episode a digit. Write `lost`: the success rate in `before` minus the one in
# `after`, so that it is positive where something is lost.


# %% tags=["answer"]
def lost(before, after):
    return ...


# %% tags=["solution"]
def lost(before, after):
    return before.count("1") / len(before) - after.count("1") / len(after)


# %% tags=["check"]
teaching.check("06.lost", lost)

# %% [markdown]
# Which camera would you spare? Without it, the methods of this lesson lose:

# %%
print(" " * 12, *map(teaching.named, CAMERAS), sep="  ")
for name, outcomes in best.items():
    losses = [lost(outcomes["all"], outcomes[f"{camera} missing"]) for camera in CAMERAS]
    print(f"{name:12}  {losses[0]:+12.2f}  {losses[1]:+7.2f}  {losses[2]:+7.2f}")

# %% [markdown]
# ## Exercise 2: who does without First person
#
# Put the names of those methods in a list that still succeed in more than half of the episodes when
# First person is missing (`best`). Single Camera does not count: it never had First person.

# %% tags=["answer"]
sturdy = ...

# %% tags=["solution"]
without = {name: outcomes["first missing"] for name, outcomes in best.items() if name != "single"}
sturdy = [name for name, digits in without.items() if digits.count("1") > len(digits) / 2]

# %% tags=["check"]
teaching.check("06.sturdy", sturdy)

# %% [markdown] tags=["solution"]
# MAD and MVD: the two that acted without First person while they were trained. What a method has
# never met in training, its structure does not give it.
