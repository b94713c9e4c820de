# %% [markdown]
# # Solution 3: Singular Only
#
# It was never trained on a sum, and the norm of a sum is larger than that of any feature it was
# trained on. It works from single cameras. On all three its actions come from new inputs:
# sometimes they are good, but it was not trained for them.

# %%
from madviz import teaching
from madviz.teaching.lessons import measure

teaching.begin()
singular = teaching.train_small("singular-only", rounds=6, updates=100)
measured = measure(singular.policy, ["all", "first", "third_a", "third_b"], 40)
teaching.success_table({"singular-only": measured})

# %% [markdown]
# Compare the row `all` with MAD's in the lesson, and note the intervals: 40 episodes show the
# difference between 0.9 and 0.5, but not between 0.9 and 0.8.
