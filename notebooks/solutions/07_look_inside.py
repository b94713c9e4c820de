# %% [markdown]
# # Solution 7: six orders by hand

# %%
from itertools import permutations

import madviz
from madviz import teaching
from madviz.subsets import mask_of, name_of
from madviz.teaching.inside import success_shapley
from madviz.teaching.show import table

name = "metaworld-hammer-merged-only-light"
streams = madviz.load_policy(name).spec.streams
counted = teaching.shipped(name)
rates = {subset: successes / n for subset, (successes, n) in counted.items()}


def rate(cameras):
    return rates[name_of(mask_of("+".join(cameras) or "none", streams), streams)]


rows, added = [], []
for order in permutations(streams):
    before = order[: order.index("first")]
    added.append(rate([*before, "first"]) - rate(before))
    rows.append([", ".join(order), " + ".join(before) or "none", added[-1]])
table(["order", "present before First person", "what it adds"], rows)

# %%
print(f"mean of the six: {sum(added) / 6:.3f}")
assert abs(sum(added) / 6 - success_shapley(counted, streams)[0].cameras[0]) < 1e-9

# %% [markdown]
# Third B can be spared (without it success is 1.00), and Third A costs a fifth. So "success
# without it" alone would say that Third B adds nothing; but once Third A is missing, Third B is
# what is left. And alone, Third A and Third B seem equally useless (0.00 each), though the
# Shapley value of Third A is twice as large.
