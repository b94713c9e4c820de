# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 9. The live page: an experiment of your own
#
# **Question: merged-only needs First person. But until when? Once the hammer is in the hand, can
# the camera go?**
#
# The card of a policy counts episodes in which a camera is missing from the first step to the last.
# On the live page you can take it away in the middle. First you look, then you write a plan, then
# you run it, and then you compare: what was planned, and what came out? The plan comes before the
# numbers, because afterwards everybody finds a reason for what happened.
#
# Time: 45 minutes. Lesson 4 comes before this one.

# %%
import hashlib
import json

import madviz
from madviz import teaching
from madviz.measure.statistics import wilson
from madviz.observation.ablation import Ablation, CameraState
from madviz.session.commands import SetCamera
from madviz.session.simulation import Simulation
from madviz.teaching.lessons import interval_figure
from madviz.teaching.show import bars, table
from madviz.widgets import Predict, TryOut, live_page

teaching.begin()
POLICY = "metaworld-hammer-merged-only-light"

# %% [markdown]
# ## Look
#
# `madviz explore` serves a page for a browser; here it is shown in the notebook. If your browser
# and the notebook's kernel are on different machines (a class server, for example), the page is
# passed on by the notebook's own server, and its address then ends in `/proxy/PORT/`. The slash
# at the end matters. The first picture takes some seconds. In a saved notebook you see an empty
# frame instead: there is no server behind it.

# %%
page = live_page(POLICY)
page

# %% [markdown]
# The same page in a window of its own (on this machine): open the address below. The page ends with
# this notebook's kernel, and sooner with `page.close()`.

# %%
page.direct

# %% tags=["prediction"]
guess = Predict(
    "The policy has three cameras. Without which one, from the first step on, does it do worst?",
    ["First person", "Third A", "Third B"],
)
guess

# %% [markdown]
# Switch off one camera at a time, play some episodes at *full speed*, and keep a tally: how many
# episodes, how many successes? The sliders say what your tally is worth.

# %%
TryOut(interval_figure, successes=(0, 20, 1), n=(1, 20, 1))

# %% [markdown]
# The card's numbers, from 100 episodes each (shipped):

# %%
shipped = teaching.shipped(POLICY)
without = {
    "First person": shipped["third_a+third_b"],
    "Third A": shipped["first+third_b"],
    "Third B": shipped["first+third_a"],
}
table(["without", "success"], [[name, teaching.in_words(*one)] for name, one in without.items()])

# %%
worst = min(without, key=without.get)
guess.compare(f"without {worst}")

# %% [markdown]
# Now the question of this lesson. Play an episode with all cameras, and note the step (it stands
# beside *pause*) at which the hand has the hammer. Then play others, and switch First person off
# before that step and after it. Look at a few, and do not count yet.
#
# ## Exercise 1: the plan
#
# Write down what you will do and what you expect. A condition is a step: there First person is
# dropped, for the rest of the episode; `None` means never, and a plan without that has nothing to
# compare with. Every condition has the same `episodes` seeds, from `first_seed` on. For each one
# say which success rates you expect, `(lowest, highest)`. And say which result would show that you
# are wrong: if there is none, the experiment cannot tell you anything. An episode takes about two
# seconds, so 24 episodes in all take about a minute.

# %% tags=["answer"]
plan = {
    "question": "",
    "conditions": {},  # A name for each, and the step: {"all cameras": None, "early": 10, ...}
    "episodes": ...,
    "first_seed": ...,
    "expect": {},  # The same names, and (lowest, highest): {"all cameras": (0.7, 1.0), ...}
    "wrong_if": "",
}

# %% tags=["solution"]
plan = {
    "question": "Does merged-only need First person only until the hand has the hammer?",
    "conditions": {"all cameras": None, "step 10": 10, "step 60": 60},
    "episodes": 8,
    "first_seed": 2000,
    "expect": {"all cameras": (0.6, 1.0), "step 10": (0.0, 0.4), "step 60": (0.6, 1.0)},
    "wrong_if": "dropping it at step 60 costs half of the successes or more",
}

# %% tags=["check"]
teaching.check("09.plan", plan)

# %% [markdown]
# This is the plan's fingerprint. Tell it to your neighbour, or write it on the board. Whoever
# changes the plan afterwards has another one.

# %%
fingerprint = hashlib.sha256(json.dumps(plan).encode()).hexdigest()[:8]
fingerprint

# %% [markdown]
# ## Run it
#
# `Simulation` is what runs behind the page: one policy in one environment, and cameras that can be
# switched at any step. This is the plan, and nothing else:

# %%
policy = madviz.load_policy(POLICY)
env = madviz.make_env(policy.spec.task, policy.spec.render_profile, policy.spec.cameras)
outcomes = {}
for name, step in plan["conditions"].items():
    outcomes[name] = ""
    for seed in range(plan["first_seed"], plan["first_seed"] + plan["episodes"]):
        simulation = Simulation(env, policy, Ablation())
        simulation.begin(seed)
        while not simulation.ended:
            if simulation.now.step == step:
                simulation.set_camera(SetCamera("first", CameraState("off")))
            simulation.step(lambda: None)
        outcomes[name] += str(int(simulation.now.time.success))
    print(f"{name}: {outcomes[name]}")
env.close()

# %% [markdown]
# ## Exercise 2: planned and measured
#
# A rate from a few episodes is not the true one, so compare the *interval* with what you expected.
# Write `verdict`, which gets two pairs `(low, high)`:
#
# - `"as planned"`: every rate in the measured interval is one that you expected,
# - `"not as planned"`: none of them is,
# - `"cannot say"`: some are, and some are not.


# %% tags=["answer"]
def verdict(expected, interval):
    return ...


# %% tags=["solution"]
def verdict(expected, interval):
    (low, high), (least, most) = expected, interval
    if low <= least and most <= high:
        return "as planned"
    return "not as planned" if most < low or high < least else "cannot say"


# %% tags=["check"]
teaching.check("09.verdict", verdict)

# %%
counted = {name: (digits.count("1"), len(digits)) for name, digits in outcomes.items()}
bars(
    "success by the step at which First person is dropped",
    list(counted),
    {"measured": list(counted.values())},
)

# %%
rows = []
for name, (successes, n) in counted.items():
    (low, high), expected = wilson(successes, n), plan["expect"][name]
    measured = f"{successes} of {n}, [{low:.2f}, {high:.2f}]"
    rows.append([name, f"{expected[0]} to {expected[1]}", measured, verdict(expected, (low, high))])
print("plan", hashlib.sha256(json.dumps(plan).encode()).hexdigest()[:8])
table(["First person dropped", "planned", "measured, 95% interval", "verdict"], rows)

# %% [markdown]
# Did what you wrote under `wrong_if` happen? *Cannot say* is a result, too: so many episodes were
# too few for this question. How many would you write into the next plan (lesson 4)? And what would
# you change in it: other steps, another camera, *black* in place of *off*?
#
# Write the next plan under this one, with a new fingerprint. Do not change the old one.

# %% [markdown] tags=["solution"]
# In the saved run all three came out as planned: the policy needs First person at step 10, and can
# do without it from step 60 on. Eight episodes could say so only because all eight came out alike.
# Between these steps, where some succeed and some fail, the interval of eight is wider than most
# expectations, and the verdict is *cannot say*. The next plan asks for one or two such steps and
# thirty episodes of each. And *off* is not *black* (lesson 4), so it says nothing about a broken
# camera.
