# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 3. Disentangle
#
# **Question: two policies see the same three cameras and learn from the same demonstrations. Why
# does one of them still work when cameras are taken away, and the other does not?**
#
# You will train both, here and now, on a small task, and take cameras away from both. The
# difference between them is one line of mathematics.
#
# Time: 45 minutes, some minutes of which are training. Start with *Run all*, and read while it
# computes.

# %%
import madviz
from madviz import teaching
from madviz.agent import objectives
from madviz.agent.methods import method
from madviz.measure.statistics import pair
from madviz.teaching.lessons import subset_table
from madviz.teaching.show import curves, sheet, source, table
from madviz.training import light
from madviz.widgets import Explorer, Predict

teaching.begin()
ROUNDS, UPDATES, BATCH = 6, 100, 16  # Of the trainings below.
HAMMER = False  # True also trains MAD on a real robot task, in about 28 minutes.
HAMMER_TASK, HAMMER_SIZE, HAMMER_EPISODES = "metaworld/hammer", light.LightConfig(rounds=20), 20

# %% [markdown]
# ## The formulas, and the code that ships
#
# Every sample of a training is read several times: once *merged*, $M = V_1 + V_2 + V_3$, and once
# for every camera alone, as if the others were missing. From each reading comes a loss $\mathcal
# L$. MAD's objective is
#
# $$ \mathcal L = \alpha \, \mathcal L(M) + (1 - \alpha) \, \frac1n \sum_i \mathcal L(V_i) $$
#
# and the method it is compared with, *Merged Only*, has $\alpha = 1$: it never reads a camera
# alone. In the code a method is a row in a table, and the row says what weighs how much:

# %%
streams = ("first", "third_a", "third_b")
table(
    ["method", *map(teaching.named, method("mad").rows(streams))],
    [
        ["mad, alpha 0.5", *method("mad").row_weights(streams, 0.5)],
        ["merged-only", *method("merged-only").row_weights(streams, 0.5), "", "", ""],
    ],
)

# %% [markdown]
# The sum with its weights, exactly as the reinforcement learning of this package runs it:

# %%
source(objectives.merged, objectives.singular, objectives.weighted)

# %% [markdown]
# In reinforcement learning $\mathcal L$ is a critic's or an actor's loss. What makes it MAD is
# where the learning target comes from: from the merged feature only, so that a single camera is
# never its own teacher. This is the critic's target and its losses, one per reading; `reads` is
# the merged feature, `rows` are all readings:

# %%
source(objectives.td_target, objectives.critic_losses)

# %% [markdown]
# Reinforcement learning takes days on a laptop. So that you can train in minutes, the *light*
# recipe learns by imitation: an expert (a small program that reads the simulator's true state)
# says what it would do, and the loss is the squared distance to that. The weights are MAD's, and
# everything else stays:

# %%
source(light.imitation_loss, light.row_errors)

# %% [markdown]
# ## The task
#
# `toy/reach` is a table drawn with a few lines of NumPy. A hand (blue) has to get to a target
# (orange) in 25 decisions. The first camera is mounted on the hand and sees only its
# surroundings.
#
# `train_small` is `madviz train --task toy/reach --recipe light` with small numbers (600 updates,
# 16 samples each), and it does not train again what is saved already.

# %%
mad = teaching.train_small("mad", rounds=ROUNDS, updates=UPDATES, batch=BATCH)
print(f"\nMAD: {mad.seconds:.0f} s")

# %%
merged_only = teaching.train_small("merged-only", rounds=ROUNDS, updates=UPDATES, batch=BATCH)
print(f"\nMerged Only: {merged_only.seconds:.0f} s")

# %%
start = teaching.moment_at(mad.policy, step=0)
sheet({teaching.named(camera): view.rgb for camera, view in start.views.items()})

# %%
curves(
    "loss while training, highest = 1",
    "updates",
    {
        name: ([row["updates"] for row in run.curve], [row["loss"] for row in run.curve])
        for name, run in (("mad", mad), ("merged-only", merged_only))
    },
)

# %% [markdown]
# Do not compare the heights of the two curves: MAD's loss is an average over four readings, three
# of which are harder. The merged one alone is easier to imitate.

# %% [markdown]
# ## Take cameras away

# %% tags=["prediction"]
guess = Predict(
    "Both policies work with all three cameras. With one camera alone, Merged Only will",
    ["work, whichever it is", "work with some cameras and fail with others", "fail with every one"],
)
guess

# %%
subsets = ["all", *streams]
results = {
    name: madviz.evaluate(run.policy, subsets, episodes=40, seed=5000)
    for name, run in (("mad", mad), ("merged-only", merged_only))
}
measured = {name: teaching.counts(result.rows) for name, result in results.items()}
teaching.success_bars("success on toy/reach, 40 episodes each", measured)

# %%
teaching.success_table(measured)

# %%
third = [measured["merged-only"][name] for name in ("third_a", "third_b")]
number = teaching.in_words(sum(s for s, _ in third), sum(n for _, n in third))
print(
    "Merged Only on First person alone:    ", teaching.in_words(*measured["merged-only"]["first"])
)
print("Merged Only on Third A, or on Third B:", number)
guess.compare(
    ", ".join(
        f"{s} of {n} with {teaching.named(name)}"
        for name, (s, n) in measured["merged-only"].items()
    )
)

# %% [markdown]
# Both policies had the same episodes, so they can be compared one by one. Only the episodes that
# one of them solves and the other does not say anything about which is better:

# %%
compared = pair(results["mad"].outcomes("third_b"), results["merged-only"].outcomes("third_b"))
low, high = compared.interval()
print(f"Third B alone: only MAD {compared.first_only}, only Merged Only {compared.second_only}")
print(f"difference {compared.difference:+.2f}, 95% interval [{low:+.2f}, {high:+.2f}]")
print(f"exact p = {compared.mcnemar():.2g}")

# %% [markdown]
# ## Why
#
# Merged Only learned an actor for sums of three features, and nothing made it read every term of
# the sum. In the saved run it came to rely on the camera on the hand, where *go towards the
# orange spot* is easiest to learn: with that one alone it still works more often than not, and
# without it it fails. Which camera a policy depends on is decided by chance and by what is easy
# to learn; the sum hides it, until the camera is missing. MAD's actor had to act on each of them.
# Compare both policies at the same time step: how far are the actions of single cameras from that
# of all?

# %%
subset_table(teaching.moment_at(mad.policy, step=2))

# %%
subset_table(teaching.moment_at(merged_only.policy, step=2))

# %% [markdown]
# ## Play
#
# This is the policy *you* trained without disentangling. Switch two cameras off and see where the
# hand goes. Then put `mad.policy` in its place.

# %%
explorer = Explorer(merged_only.policy, seed=2003)
explorer

# %% [markdown]
# ## Is it the same on a real robot task?
#
# The included hammer policies were trained by the same recipe, for longer and with larger networks;
# these are their results (100 episodes each, measured before):

# %%
SHIPPED_MAD, SHIPPED_MERGED = "metaworld-hammer-mad-light", "metaworld-hammer-merged-only-light"
hammer = {
    "mad": teaching.shipped(SHIPPED_MAD),
    "merged-only": teaching.shipped(SHIPPED_MERGED),
}
teaching.success_table(hammer)

# %% [markdown]
# There, merged-only fails on every single camera: each of them alone is too little for it. The
# toy's numbers are yours, from a training of a minute. They show the mechanism; they are not a
# result about robots. The hammer's come from a longer training, again by imitation.
#
# ### An option: train MAD on hammer yourself
#
# Set `HAMMER = True` at the top, and the next cell trains MAD on hammer just as the shipped policy
# was trained. That took 28 minutes on two cores (its card says so), and here a few minutes more to
# count successes with and without cameras; a busy laptop needs twice that. Every round says how
# many minutes are left. You may stop it and run the cell again: it is resumed. It is off in the
# saved lesson, and then the figure and the table show the shipped policies alone.

# %%
own = teaching.train_light(HAMMER_TASK, "mad", HAMMER_SIZE) if HAMMER else None
if own:
    tried = madviz.evaluate(own.folder, ["all", *streams], episodes=HAMMER_EPISODES, seed=5000)
    hammer = {"mad, trained here": teaching.counts(tried.rows), **hammer}
    print(f"\nExplore it with: madviz explore --policy {own.folder}")
teaching.success_bars("success on hammer (shipped: n = 100)", hammer)

# %% [markdown]
# Episode by episode against the shipped Merged Only, with one camera left:

# %%
teaching.paired_table(
    ("mad", "merged-only"),
    {
        camera: (
            tried.outcomes(camera) if own else teaching.shipped_outcomes(SHIPPED_MAD, camera),
            teaching.shipped_outcomes(SHIPPED_MERGED, camera, development=bool(own)),
        )
        for camera in streams
    },
)

# %% [markdown]
# If you trained your own, take its cameras away by hand as well:

# %%
hammer_explorer = Explorer(own.policy, seed=2000) if own else None
hammer_explorer

# %% [markdown]
# ## Exercise 1: the objective
#
# Write MAD's objective as a function: `merged` is $\mathcal L(M)$, a number; `singles` is an array
# with $\mathcal L(V_i)$ of every camera, however many there are.


# %% tags=["answer"]
def loss(merged, singles, alpha):
    return ...


# %% tags=["solution"]
def loss(merged, singles, alpha):
    return alpha * merged + (1 - alpha) * singles.mean()


# %% tags=["check"]
teaching.check("03.loss", loss)

# %% [markdown]
# ## Exercise 2: Singular Only
#
# The method *Singular Only* reads every camera alone and never the sum. What are its four weights,
# in the order of the table at the top of this lesson?

# %% tags=["answer"]
weights = ...

# %% tags=["solution"]
weights = [0, 1 / 3, 1 / 3, 1 / 3]

# %% tags=["check"]
teaching.check("03.weights", weights)

# %% [markdown]
# If there is time, train it. Before you do, say what it will do with all three cameras, and why.
#
#     singular = teaching.train_small("singular-only", rounds=ROUNDS, updates=UPDATES, batch=BATCH)
#     found = madviz.evaluate(singular.policy, subsets, episodes=40, seed=5000)
#     teaching.success_table({"singular-only": teaching.counts(found.rows)})

# %% [markdown] tags=["solution"]
# It was never trained on a sum, and the norm of a sum is larger than that of any feature it was
# trained on. It works from single cameras. On all three its actions come from new inputs:
# sometimes they are good, but it was not trained for them. Compare the row `all` with MAD's, and
# note the intervals: 40 episodes show the difference between 0.9 and 0.5, but not between 0.9 and
# 0.8.
