# %% [markdown]
# # Solution 8: when does it hurt to lose First person?
#
# The same on code: in each of a few episodes the first camera is dropped after some decisions.

# %%
import madviz
from madviz import teaching
from madviz.observation.ablation import Ablation, CameraState
from madviz.session.commands import SetCamera
from madviz.session.simulation import Simulation
from madviz.teaching.show import table

teaching.begin()
policy = madviz.load_policy("metaworld-hammer-merged-only-light")
env = madviz.make_env(policy.spec.task, policy.spec.render_profile, policy.spec.cameras)
rows = []
for decisions in (10, 60):
    successes, seeds = 0, (2000, 2001, 2002)
    for seed in seeds:
        simulation = Simulation(env, policy, Ablation())
        simulation.begin(seed)
        while not simulation.ended:
            if simulation.now.step == decisions:
                simulation.set_camera(SetCamera("first", CameraState("off")))
            simulation.step(lambda: None)
        successes += simulation.now.time.success
    rows.append([decisions, teaching.in_words(successes, len(seeds))])
env.close()
table(["dropped after", "success"], rows)

# %% [markdown]
# Three episodes of each say little; the intervals say how little. Take thirty if you have ten
# minutes.
