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
| `plot_ablations(runs, whole)` | returns with one part of DDPG taken out |
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
| `plot_y(y, expected)` | what one noisy target says, as a histogram |
| `plot_maximum(…)` | the same, and its mean over the number of actions |
| `plot_growth(cases)` | a bias made anew in each target, piling up |
| `plot_steps(curves, points)` | two actors' steps on a true and a learned Q |
| `plot_error_and_share(pictures, limit)` | mean error planes, share of seeds above 0 |
| `plot_owed(table, owed, control, debt)` | bias, what lag owes, frozen actors |
| `plot_along_action(action, cases, added)` | error along the action: offset and slope |
| `plot_one_backup(x, forms, samples)` | closed forms of one target, and samples |
| `plot_over_training(table, columns)` | measured quantities over the steps, by seed |
| `plot_parts(parts)` | a bias taken apart into two sums |
| `plot_mean_planes(planes, limit)` | mean error planes of several algorithms |
| `plot_distance(curves)` | how far apart two actors' actions are |
| `plot_differences_by_seed(differences)` | paired differences, mean and interval |
| `plot_eight_tasks(curves, interval)` | learning curves, a panel for each task |
| `plot_coverage(n, shares)` | how often an interval holds the truth |
| `plot_profile(levels, profiles, iqms)` | all tasks in one: profile, quartile means |
| `plot_paired_by_task(differences)` | paired differences, task by task |
| `plot_verdicts(table, tasks)` | claims and verdicts, as a coloured table |
| `plot_bias_and_return(groups)` | bias against return, a mark per run |
| `plot_climbing(predicted, measured, best, usual)` | which noise climbs the hill |
| `plot_energy_paths(x, y, energy, paths)` | a car's paths over lines of equal energy |
| `plot_found_or_not(pictures)` | truth, critic, error of several agents |
| `plot_pushes(cases)` | random pushes, and where they move the car |
| `plot_visits(runs, x, y, energy)` | where the car was during training |
| `plot_arm(state, paths, q)` | an arm, its observation, Q of two proposals |
| `plot_fastest(steps, start, ends, counts)` | steps to the goal, two elbow branches |
| `plot_reaching(tables, columns)` | success, time and regret over the steps |
| `plot_joint_errors(pictures, limit)` | error planes over the two joints |
| `plot_fates(fates)` | what became of 100 starts, as stacked bars |
| `plot_hovering(worth, counters)` | what hovering is worth; steps on goal in a row |
| `plot_readings(added)` | what each reading of the target adds to Q |
| `plot_who_acts(constants, share, lost)` | a constant decides which actor acts |
| `plot_table_1(schedules, values, limit)` | slow copies' pace, and a limit on y |
| `plot_ends(length, cut, whole, tasks)` | a wrong end is a wrong discount |
| `plot_links(alpha, shares)` | in how many random worlds each link holds |
| `plot_consequences(found)` | paired differences of many readings, by seed |
| `plot_body(picture, joints)` | a body, its motors and what it observes of them |
| `plot_restored(gaps)` | how far worlds that were put back go astray |
| `plot_kept(q, truth)` | Q against the truth in states put back |
| `plot_live(episodes, evaluations, …)` | a live run, and its critic's Q and truth |
| `plot_returns(table)` | recorded returns on MuJoCo's four tasks |
| `plot_lag(table)` | bias, and below it what is owed to lag, on four tasks |
| `plot_runs(scores)` | return against bias, a mark for each run |
| `plot_decays(curves, limits)` | an error that all states share, dying |
| `plot_line_up(agents)` | return, Q and truth of six agents under letters |
| `plot_practice(agents)` | returns in training beside returns in tests |
| `plot_questions(groups)` | one critic asked in three ways, and the truth |

One module for each group of chapters; `style.py` holds what they share.
"""

from dnddpg_minimal.plots.arm import (
    FATES,
    draw_arm,
    draw_room,
    plot_arm,
    plot_fastest,
    plot_fates,
    plot_hovering,
    plot_joint_errors,
    plot_reaching,
)
from dnddpg_minimal.plots.critics import (
    plot_differences_by_seed,
    plot_distance,
    plot_mean_planes,
    plot_one_backup,
    plot_over_training,
    plot_parts,
)
from dnddpg_minimal.plots.ddpg import (
    plot_ablations,
    plot_bias,
    plot_error_plane,
    plot_filmstrip,
    plot_learning,
    plot_memory,
    plot_q,
    plot_truth,
)
from dnddpg_minimal.plots.figure_6 import (
    plot_coverage,
    plot_eight_tasks,
    plot_paired_by_task,
    plot_profile,
    plot_verdicts,
)
from dnddpg_minimal.plots.mountain_car import (
    plot_bias_and_return,
    plot_climbing,
    plot_energy_paths,
    plot_found_or_not,
    plot_pushes,
    plot_visits,
)
from dnddpg_minimal.plots.mujoco import (
    photograph,
    plot_body,
    plot_kept,
    plot_lag,
    plot_live,
    plot_restored,
    plot_returns,
    plot_runs,
    write_bodies,
)
from dnddpg_minimal.plots.overestimation import (
    plot_along_action,
    plot_error_and_share,
    plot_growth,
    plot_maximum,
    plot_owed,
    plot_steps,
    plot_y,
)
from dnddpg_minimal.plots.paper_court import (
    plot_consequences,
    plot_ends,
    plot_links,
    plot_readings,
    plot_table_1,
    plot_who_acts,
)
from dnddpg_minimal.plots.silent_bugs import (
    plot_decays,
    plot_line_up,
    plot_practice,
    plot_questions,
)
from dnddpg_minimal.plots.style import (
    ERRORS,
    GREY,
    MARKS,
    ONE,
    SIGN,
    SIGN_BAR,
    SIGN_TURNED,
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
    panels,
    shades,
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
    "ERRORS", "FATES", "GREY", "MARKS", "ONE", "SIGN", "SIGN_BAR", "SIGN_TURNED",
    "STYLE", "THREE", "TRUTH", "TWO", "VALUES", "WRONG", "angle_ticks", "draw_arm",
    "draw_lines", "draw_map", "draw_room", "is_angle", "legend_below", "note_level",
    "pale", "panels", "photograph", "plot_ablations", "plot_actor", "plot_along_action",
    "plot_arm", "plot_bias", "plot_bias_and_return", "plot_body", "plot_climbing",
    "plot_consequences", "plot_coverage", "plot_decay", "plot_decays",
    "plot_differences_by_seed", "plot_distance", "plot_eight_tasks", "plot_ends",
    "plot_energy_paths", "plot_error_and_share", "plot_error_plane", "plot_fastest",
    "plot_fates", "plot_filmstrip", "plot_finite_differences", "plot_found_or_not",
    "plot_growth", "plot_hill", "plot_hovering", "plot_joint_errors", "plot_kept",
    "plot_lag", "plot_learned_q", "plot_learning", "plot_line_up", "plot_links",
    "plot_live", "plot_maximum", "plot_mean_planes", "plot_memory", "plot_one_backup",
    "plot_over_training", "plot_owed", "plot_paired_by_task", "plot_partial_sums",
    "plot_parts", "plot_practice", "plot_price", "plot_profile", "plot_pushes",
    "plot_q", "plot_questions", "plot_reaching", "plot_readings", "plot_restored",
    "plot_returns", "plot_runs", "plot_slices", "plot_slope_ways", "plot_steps",
    "plot_table_1", "plot_true_q", "plot_truth", "plot_verdicts", "plot_visits",
    "plot_who_acts", "plot_y", "shades", "shrink", "style_of", "thousands",
    "write_bodies", "zero_line",
]
