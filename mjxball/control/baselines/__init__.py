"""Classical followers to be beaten, each at its best: `law.start` and `law.step` run on NumPy or JAX arrays.

Their gains follow from the plant. Apart from `copy`, which is the optimum of the paper's reward, all are ours: the
adaptive controller that the paper compares with is not public.
"""

from mjxball.control.baselines.adaptive import Adaptive
from mjxball.control.baselines.floors import Copy, Random, Stay
from mjxball.control.baselines.lqg import Lqg, Memoryless, SlowLqg
from mjxball.control.baselines.oracle import Oracle
from mjxball.control.baselines.pair_lqg import PairLqg

__all__ = ["Adaptive", "Copy", "Lqg", "Memoryless", "Oracle", "PairLqg", "Random", "SlowLqg", "Stay"]
