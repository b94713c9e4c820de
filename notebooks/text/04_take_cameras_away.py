# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 4. Take cameras away
#
# **Question: a camera can be missing, or it can send nonsense. Is that the same for a policy? And
# how many episodes does it take to know?**
#
# Time: 50 minutes. Some cells run the hammer task, at a few seconds per episode.

# %%
import numpy as np

import madviz
from madviz import teaching
from madviz.measure.statistics import Paired, pair, wilson
from madviz.observation.ablation import Occlusion
from madviz.teaching.lessons import interval_figure, occlusion_sheet
from madviz.teaching.show import table
from madviz.widgets import Explorer, Predict, TryOut

teaching.begin()
MAD, MERGED_ONLY = "metaworld-hammer-mad-light", "metaworld-hammer-merged-only-light"
mad, merged_only = madviz.load_policy(MAD), madviz.load_policy(MERGED_ONLY)
now = teaching.moment_at(mad, seed=2000, step=20)

# %% [markdown]
# ## Two ways to lose a camera
#
# **Dropped**: it is known that the camera is missing, and its feature is left out of the sum.
#
# **Occluded**: the camera still sends pictures, but bad ones: black, noise, the same picture for
# ever (*freeze*), out of focus (*blur*), with something stuck to the lens (*patch*), with
# pictures missing now and then (*lossy*), or all of them late (*late*). The policy gets no
# other sign.

# %%
occlusion_sheet(now)

# %% [markdown]
# ## Is black the same as nothing?

# %% tags=["prediction"]
guess = Predict(
    "A black picture shows nothing. What is its feature?",
    ["All zeros, so black is the same as dropped", "Not zero, so black adds something to the sum"],
)
guess

# %%
black = {"third_a": Occlusion("black")}
blacked = teaching.occluded(now, black)
rows = [
    [teaching.named(camera), now.probe.norms[i], blacked.probe.norms[i]]
    for i, camera in enumerate(mad.spec.streams)
]
table(["camera", "norm of its feature", "when Third A sends black"], rows)

# %%
guess.compare(f"a black Third A has a feature of norm {blacked.probe.norms[1]:.1f}")

# %% [markdown]
# Black is a picture like any other: the network answers with a feature, and that goes into the
# sum as if it meant something. The policy was not trained on it. Its norm can even be larger than
# that of a real picture's feature. How far does the action move, at this time step?

# %%
intact = now.action()
rows = [["dropped", float(abs(now.action("first+third_b") - intact).max())]]
for kind in ("black", "noise", "freeze", "blur"):
    failed = teaching.occluded(now, {"third_a": Occlusion(kind)})
    rows.append([kind, float(abs(failed.action() - intact).max())])
table(["Third A is", "largest change of one action number"], rows)

# %% [markdown]
# A frozen picture seems harmless, and in the saved run it moves the action most: the policy gets
# the same picture three times, which says that nothing moves (lesson 1), while the hand does. How
# far an action moves is not yet success or failure; that is counted below.
#
# ## Play
#
# This is the policy that never learned to do without cameras. Find an occlusion of one camera
# that makes it fail, while dropping the same camera does not; or the other way round.

# %%
explorer = Explorer(merged_only, seed=2000)
explorer

# %% [markdown]
# ## Success, a few episodes at a time
#
# Four episodes each, run now, with Third A intact, dropped and black, for Merged Only:

# %%
few = {
    "intact": madviz.evaluate(merged_only, ["all"], episodes=4, seed=5000),
    "dropped": madviz.evaluate(merged_only, ["first+third_b"], episodes=4, seed=5000),
    "black": madviz.evaluate(merged_only, ["all"], episodes=4, occlusions=black, seed=5000),
}
for name, result in few.items():
    (counted,) = teaching.counts(result.rows).values()
    print(f"{name:8}", teaching.in_words(*counted))

# %% [markdown]
# Read the intervals before you conclude anything: with four episodes they are so wide that most
# of them overlap. *Dropped* and *black* are the same camera missing, and they need not be the
# same to the policy.
#
# ## How many episodes are enough?
#
# Wilson's interval says which true rates are compatible with what you counted. Move the sliders:
# what does 8 of 10 say, and what 80 of 100?

# %%
TryOut(interval_figure, successes=(0, 50, 1), n=(1, 50, 1))

# %%
rows = []
for n in (5, 10, 20, 50, 100, 400):
    low, high = wilson(round(0.8 * n), n)
    rows.append([n, f"[{low:.2f}, {high:.2f}]", high - low])
table(["episodes", "95% interval around 0.8", "width"], rows)

# %% [markdown]
# Half the width costs four times the episodes. To distinguish 0.8 from 0.9 you need a few hundred
# of each; for 1.00 and 0.00 on the same episodes, six are enough.
#
# The cards of the included policies were measured on 100 episodes per subset of cameras. These
# numbers are shipped, nothing runs here:

# %%
shipped = {"mad": teaching.shipped(MAD), "merged-only": teaching.shipped(MERGED_ONLY)}
teaching.success_bars("hammer, n = 100 for every bar (shipped)", shipped)

# %%
teaching.success_table(shipped)

# %% [markdown]
# ## Compared episode by episode
#
# Both policies had the same 100 episodes. One that both solve, or both fail, says nothing about
# which is better; the others are like tosses of a coin, and McNemar's test asks whether it is a
# fair one.

# %% tags=["prediction"]
guess_pair = Predict(
    "Above, merged-only is behind mad without Third A. Could that be chance?",
    ["Yes, 100 episodes are too few", "Hardly"],
)
guess_pair

# %%
subset = "first+third_b"
outcomes = [teaching.shipped_outcomes(name, subset) for name in (MAD, MERGED_ONLY)]
compared = pair(*outcomes)
table(
    ["both", "only mad", "only merged-only", "neither"],
    [[compared.both, compared.first_only, compared.second_only, compared.neither]],
)

# %%
low, high = compared.interval()
print(f"difference {compared.difference:+.2f}, 95% interval [{low:+.2f}, {high:+.2f}]")
guess_pair.compare(f"exact p = {compared.mcnemar():.2g}, so hardly chance")

# %% [markdown]
# ## Exercise 1: nine of ten against seven of ten
#
# Policy A solved 9 of ten episodes, policy B solved 7 of *the same* ten. Is A better? That depends
# on which episodes they were. Make the best case for A (A solves every episode that B solves) and
# the worst one (as few as possible that both fail): a `Paired` with the four numbers of the table
# above, such as `Paired(both=6, first_only=1, second_only=1, neither=2)`, where *first* is A.

# %% tags=["answer"]
best = ...
worst = ...

# %% tags=["solution"]
best = Paired(both=7, first_only=2, second_only=0, neither=1)
worst = Paired(both=6, first_only=3, second_only=1, neither=0)

# %% tags=["check"]
teaching.check("04.paired", best, worst)

# %%
for name, case in (("best", best), ("worst", worst)):
    low, high = case.interval()
    print(f"{name}: {case.difference:+.2f} [{low:+.2f}, {high:+.2f}], p = {case.mcnemar():.2g}")

# %% [markdown]
# ## Exercise 2: how many would be enough?
#
# Suppose the rates stay what they are, and every case is the best one for A. What is the smallest
# number of episodes, a multiple of ten, for which p is below 0.05?

# %% tags=["answer"]
episodes = ...

# %% tags=["solution"]
cases = [Paired(both=7 * k, first_only=2 * k, second_only=0, neither=k) for k in range(1, 11)]
episodes = next(case.n for case in cases if case.mcnemar() < 0.05)

# %% tags=["check"]
teaching.check("04.episodes", episodes)

# %% [markdown] tags=["solution"]
# With ten episodes neither case says that A is better: two tosses that both come up heads are no
# evidence. With thirty the best case does, as six tosses that come up alike are rare. Only episodes
# with different outcomes count.

# %% [markdown]
# ## Exercise 3: notice a frozen camera
#
# MAD can act without a camera. But somebody has to tell it that the camera is broken. Write a test
# for one step: `picture` is the newest one of a camera, `before` the one of the step before, both
# (84, 84, 3); `state` and `state_before` say where the robot's hand was, (3,), in metres. It is
# true where the camera looks frozen. Begin with the pictures alone.


# %% tags=["answer"]
def frozen(picture, before, state, state_before):
    return ...


# %% tags=["solution"]
def frozen(picture, before, state, state_before):
    return np.array_equal(picture, before)


# %% tags=["check"]
teaching.check("04.frozen", frozen)

# %% [markdown]
# Three episodes to try it on: one with a frozen Third A, an intact one, and an intact one in which
# the robot waits for ten steps, as somebody holds it up. How often does the test raise an alarm?

# %%
intact_run = list(teaching.moments(mad, seed=2000))
stuck_run = list(teaching.moments(mad, seed=2000, occlusions={"third_a": Occlusion("freeze")}))
runs = {
    "frozen": stuck_run,
    "intact": intact_run,
    "intact, waits": [*intact_run[:40], *[intact_run[40]] * 10, *intact_run[41:]],
}


def alarms(test, run):
    # The state has three frames of eight numbers; where the hand is now begins the newest.
    seen = [(moment.arrived["third_a"], moment.state[-8:-5]) for moment in run]
    pairs = zip(seen[1:], seen, strict=False)
    return sum(bool(test(now[0], then[0], now[1], then[1])) for now, then in pairs)


table(["Third A", "steps", "alarms"], [[k, len(r) - 1, alarms(frozen, r)] for k, r in runs.items()])

# %% [markdown]
# A robot that stands still sees the same picture twice, and nothing is wrong.
#
# ## Exercise 4: frozen, or still?
#
# Repair the test: which second condition makes an unchanged picture a fault?


# %% tags=["answer"]
def mended(picture, before, state, state_before):
    return ...


# %% tags=["solution"]
def mended(picture, before, state, state_before):
    moved = not np.allclose(state, state_before)
    return moved and np.array_equal(picture, before)


# %% tags=["check"]
teaching.check("04.mended", mended)

# %%
table(["Third A", "steps", "alarms"], [[k, len(r) - 1, alarms(mended, r)] for k, r in runs.items()])

# %% [markdown] tags=["solution"]
# The state tells frozen from still. The guard of this package does the same, with a margin that is
# fitted on intact episodes, and leaves the camera out until it works again:
# `madviz eval --guard --occlude third_a=freeze`. A camera whose pictures are late, or lossy, needs
# more than one step to be noticed.
