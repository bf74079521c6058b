"""The book's figures: one function per figure.

Each takes what was measured, draws it, and returns the axes. None of them trains. Pass
`ax` (or `axes`) to draw into a figure of your own. Titles state the finding, so the
caller, who knows it, passes them.

| call | shows |
|---|---|
| `plot_memory(memory, batches)` | batches of states over all the states in memory |
| `plot_q(curves, truth)` | Q during training, and what it should become |
| `plot_bias(curves, predicted)` | Q minus truth during training, and its prediction |
| `plot_learning(records, evaluations)` | returns of the episodes and of evaluations |
| `plot_filmstrip(pictures)` | a rollout in ten pictures |
| `plot_truth(picture, path)` | the true Q over two state variables, and one path |
| `plot_error_plane(picture)` | truth, a critic, and its error, side by side |
| `plot_partial_sums(sums, totals)` | discounted rewards added up to a return |
| `plot_true_q(position, action, q, lines)` | the true Q as a surface and as a map |
| `plot_finite_differences(steps, errors)` | how a step's size spoils a slope |
| `plot_slices(action, truth, guesses)` | Q along the action, true and guessed |
| `plot_decay(errors)` | how fast different errors die |
| `plot_learned_q(…)` | Q − truth as maps, and its mean over the updates |
| `plot_hill(first, second, height, paths, top)` | J over two gains, and climbers |
| `plot_slope_ways(gain, slope, ways)` | one slope, found in several ways |
| `plot_actor(position, best, actors)` | an actor's actions beside the best ones |
| `plot_price(slopes, bias, lost)` | what a critic's slope costs |
| `plot_targets(targets, expected)` | what one noisy target says, as a histogram |
| `plot_maximum(…)` | the same, and its mean over the number of actions |
| `plot_growth(panels)` | a bias made anew in each target, piling up |
| `plot_steps(curves, points)` | two actors' steps on a true and a learned Q |
| `plot_error_and_share(pictures, limit)` | mean error planes, share of seeds above 0 |
| `plot_owed(table, owed, control, predicted)` | bias, what lag owes, frozen actors |
| `plot_along_action(action, cases, added)` | error along the action: offset and slope |
| `plot_one_backup(x, forms, samples)` | closed forms of one target, and samples |
| `plot_over_training(table, columns)` | measured quantities over the steps, by seed |
| `plot_parts(parts)` | a bias taken apart into two sums |
| `plot_mean_planes(planes, limit)` | mean error planes of several algorithms |
| `plot_distance(curves)` | how far apart two actors' actions are |
| `plot_differences_by_seed(differences)` | paired differences, mean and interval |

One module for each group of chapters; `style.py` holds what they share.

    python -m dnddpg_minimal.plots notebooks/03_ddpg.ipynb

writes a chapter's last figure to `notebooks/figures/03_ddpg.png`, which the chapter
shows at its top.
"""

from dnddpg_minimal.plots.critics import (
    plot_differences_by_seed,
    plot_distance,
    plot_mean_planes,
    plot_one_backup,
    plot_over_training,
    plot_parts,
)
from dnddpg_minimal.plots.ddpg import (
    plot_bias,
    plot_error_plane,
    plot_filmstrip,
    plot_learning,
    plot_memory,
    plot_q,
    plot_truth,
)
from dnddpg_minimal.plots.overestimation import (
    plot_along_action,
    plot_error_and_share,
    plot_growth,
    plot_maximum,
    plot_owed,
    plot_steps,
    plot_targets,
)
from dnddpg_minimal.plots.style import (
    ERRORS,
    GREY,
    ONE,
    SIGN,
    STYLE,
    THREE,
    TRUTH,
    TWO,
    VALUES,
    WRONG,
    angle_ticks,
    draw_lines,
    draw_map,
    is_angle,
    legend_below,
    note_level,
    pale,
    shrink,
    style_of,
    thousands,
    zero_line,
)
from dnddpg_minimal.plots.value_and_policy import (
    plot_actor,
    plot_decay,
    plot_finite_differences,
    plot_hill,
    plot_learned_q,
    plot_partial_sums,
    plot_price,
    plot_slices,
    plot_slope_ways,
    plot_true_q,
)

__all__ = [
    "ERRORS", "GREY", "ONE", "SIGN", "STYLE", "THREE", "TRUTH", "TWO", "VALUES",
    "WRONG", "angle_ticks", "draw_lines", "draw_map", "is_angle", "legend_below",
    "note_level", "pale", "plot_actor", "plot_along_action", "plot_bias",
    "plot_decay", "plot_differences_by_seed", "plot_distance",
    "plot_error_and_share", "plot_error_plane", "plot_filmstrip",
    "plot_finite_differences", "plot_growth", "plot_hill", "plot_learned_q",
    "plot_learning", "plot_maximum", "plot_mean_planes", "plot_memory",
    "plot_one_backup", "plot_over_training", "plot_owed", "plot_partial_sums",
    "plot_parts", "plot_price", "plot_q", "plot_slices", "plot_slope_ways",
    "plot_steps", "plot_targets", "plot_true_q", "plot_truth", "shrink", "style_of",
    "thousands", "zero_line",
]
