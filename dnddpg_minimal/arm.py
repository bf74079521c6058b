"""The Arm: two links that reach for a blue square (section 4.2 of the paper).

A robot arm stands in the middle of a window of 400 x 400 pixels. The agent turns its
two joints. The paper shows the task (Figure 3) and gives no numbers; those used here
are the usual ones for an arm of this kind. `ArmEasy-v0` has its goal at (100, 100)
always, `ArmHard-v0` draws a new goal in each episode.

| what | value |
|---|---|
| window | 400 x 400 px, x to the right, y **upwards** |
| base, links | fixed at (200, 200); two links of 100 px each |
| joint 1 | angle of link 1 against the x axis, radians |
| joint 2 | angle of link 2 **against link 1**: 0 is a straight arm, pi a folded one |
| action | (2,) in [-1, 1]; each joint turns by 0.1 rad times its action |
| goal | a square of 40 px: the finger is on it if at most 20 px off in x and in y |
| observation | (9,) float32, see `observe` |
| reward | -distance / 400, finger to the goal's centre, *after* the step |
| bonus | +1 for a step that ends on goal, with `reward="distance_and_bonus"` |
| success | more than 50 steps on goal in a row: `info["success"]` |
| time limit | 300 steps (in the registration) |

| call | shape | meaning |
|---|---|---|
| `start_states(rng, n, ...)` | (N, 5) | how an episode begins |
| `locate(joints)` | (N, 2) -> (N, 2, 2) | elbow and finger, px from the base |
| `observe(states)` | (N, 5) -> (N, 9) | what the agent sees |
| `step(states, actions)` | (N, 5), (N, 2) -> ... | one step of N arms at once |
| `reference_action(states)` | (N, 5) -> (N, 2) | a policy that needs no learning |
| `reference_steps(states)` | (N, 5) -> (N,) | how many steps it takes |

A state is (joint 1, joint 2, goal x, goal y, counter): all that the future depends on.
`counter` is the number of steps on goal in a row. The agent does not see it.
The environment calls the same `observe` and `step` as the measurement of bias does,
with N = 1: there is one source of the dynamics.
"""

import difflib
import math

import gymnasium as gym
import numpy as np
from gymnasium.error import DependencyNotInstalled

WINDOW = 400.0  # px, side of the window
BASE = 200.0  # px, both coordinates of the base
LINK = 100.0  # px, length of each link
REACH = 2.0 * LINK  # px, the finger's largest distance from the base
TURN = 0.1  # rad, a joint's turn in one step at action 1
GOAL_HALF = 20.0  # px, half the side of the goal square
EASY_GOAL = (100.0, 100.0)  # px, in the window
HOLD = 50  # success: MORE than this many steps on goal in a row
FULL_TURN = 2.0 * math.pi

GOALS = ("easy", "hard")
GOAL_AREAS = ("reachable", "window")
REWARDS = ("distance", "distance_and_bonus")


# ---------------------------------------------------------------- the dynamics, pure


def start_states(rng, n, goal="easy", goal_area="reachable"):
    """Draw n states in which episodes begin.

    Both joints are uniform on the circle. The easy goal is fixed. A hard goal's centre
    is uniform in the disk that the finger can reach (`goal_area="reachable"`; the disk
    of 200 px just fits the window) or in the whole window (`"window"`: then 8.3 % of
    the goal squares lie outside the finger's reach).

    rng: numpy Generator. Returns (N, 5) float64. Raises ValueError for a wrong option.
    """
    _check_option("goal", goal, GOALS)
    _check_option("goal_area", goal_area, GOAL_AREAS)
    states = np.zeros((n, 5))
    states[:, :2] = rng.uniform(0.0, FULL_TURN, (n, 2))
    if goal == "easy":
        states[:, 2:4] = EASY_GOAL
    elif goal_area == "window":
        states[:, 2:4] = rng.uniform(0.0, WINDOW, (n, 2))
    else:
        # The root makes equal areas equally likely: a ring's area grows with its radius
        radius = REACH * np.sqrt(rng.random(n))
        direction = rng.uniform(0.0, FULL_TURN, n)
        states[:, 2] = BASE + radius * np.cos(direction)
        states[:, 3] = BASE + radius * np.sin(direction)
    return states


def locate(joints):
    """Elbow and finger in px from the base: joints (N, 2) -> (N, 2 points, xy).

    The joints are angles in radians, joint 2 against link 1.
    """
    angles = np.add.accumulate(joints, axis=1)  # of link 1, link 2 against the x axis
    points = np.empty((len(joints), 2, 2))
    np.cos(angles, out=points[:, :, 0])
    np.sin(angles, out=points[:, :, 1])
    points *= LINK  # each link as a vector
    points[:, 1] += points[:, 0]  # link 2 begins where link 1 ends
    return points


def observe(states):
    """What the agent sees: states (N, 5) -> (N, 9) float32, all within [-1, 1].

    Columns: elbow / 200 and finger / 200, seen from the base (x, y each);
    (goal - elbow) / 400 and (goal - finger) / 400 (x, y each); 1 on goal, else 0.
    The counter is not among them: how long success still takes, the agent cannot know.
    """
    points = locate(states[:, :2])
    gaps = (states[:, 2:4] - BASE)[:, None] - points  # from each point to the goal
    obs = np.empty((len(states), 9), np.float32)
    obs[:, 0:4] = points.reshape(-1, 4) / 200.0
    obs[:, 4:8] = gaps.reshape(-1, 4) / 400.0
    obs[:, 8] = _on_goal(gaps[:, 1])
    return obs


def step(states, actions, reward="distance"):
    """One step of N arms: the joints turn, the counter counts, the reward is paid.

    states: (N, 5). actions: (N, 2), clipped to [-1, 1]. reward: one of `REWARDS`.
    Returns next_states (N, 5), rewards (N,), success (N,) bool. The states given are
    not changed. Nothing ends here: a counter beyond 50 counts on, and success stays
    True while the finger stays. What success means for an episode is for `Arm` to say.
    Joints come back in [0, 2 pi] (2 pi itself only by rounding). ValueError for another
    reward.
    """
    next_states = np.array(states, np.float64)
    turn = np.minimum(np.maximum(np.asarray(actions, np.float64), -1.0), 1.0)
    turn *= TURN
    joints = next_states[:, :2]  # a view: the lines below fill next_states
    joints += turn
    np.remainder(joints, FULL_TURN, out=joints)
    gap = _gap(next_states)
    on_goal = _on_goal(gap)
    counter = next_states[:, 4]  # a view, too
    counter += 1.0
    counter *= on_goal
    rewards = np.hypot(gap[:, 0], gap[:, 1]) / -400.0
    if reward == "distance_and_bonus":
        rewards += on_goal
    elif reward != "distance":
        _check_option("reward", reward, REWARDS)
    return next_states, rewards, counter > HOLD


def _gap(states):
    """The way from the finger to the goal's centre in px, (N, 5) -> (N, xy)."""
    return states[:, 2:4] - BASE - locate(states[:, :2])[:, 1]


def _on_goal(gap):
    """Is the finger on the square? gap: goal - finger in px, (N, 2) -> (N,) bool."""
    return np.maximum.reduce(np.abs(gap), axis=1) <= GOAL_HALF


# ------------------------------------------------------------- the reference policy


def inverse_kinematics(points):
    """The joints that put the finger at a point, for both elbow branches.

    Both links are 100 px long, so arm and line to the point form a triangle with two
    equal sides: the elbow bends by 2 arccos(r / 200), to the left or to the right, and
    link 1 points half that angle to the other side. Beyond 200 px the arm stretches
    towards the point.

    points: (..., xy) px from the base -> (..., 2 branches, 2 joints) radians.
    """
    x, y = points[..., 0], points[..., 1]
    bend = 2.0 * np.arccos(np.minimum(np.hypot(x, y) / REACH, 1.0))
    second = np.stack([bend, -bend], axis=-1)
    first = np.arctan2(y, x)[..., None] - second / 2.0
    return np.stack([first, second], axis=-1)


def reference_action(states):
    """The fastest joint path to the goal: a policy that has nothing to learn.

    It looks at 82 points of the goal square and the two elbow branches of each, and
    turns both joints, the short way round and as fast as they may, towards the posture
    that needs the fewest steps; among equals, the point nearest the goal's centre.
    Once on goal it goes on to the centre, where the distance costs nothing, by a way
    that does not leave the square. If the whole square is out of reach it stretches
    towards the point of it that is nearest to the base.

    states: (N, 5) -> (N, 2) in [-1, 1]; also (5,) -> (2,).
    """
    states = np.asarray(states, np.float64)
    rows = np.atleast_2d(states)
    actions = _towards(rows, _points_of_goal(rows))
    to_centre = _towards(rows, rows[:, None, 2:4] - BASE)
    on_goal = _on_goal(_gap(rows))
    # A turn may swing the finger out of the square. So: the centre, or a point one
    # step away, or no turn at all, whichever first keeps the finger on goal
    actions[on_goal & ~_lands_on_goal(rows, actions)] = 0.0
    straight = on_goal & _lands_on_goal(rows, to_centre)
    actions[straight] = to_centre[straight]
    return actions if states.ndim == 2 else actions[0]


def reference_steps(states):
    """Steps until `reference_action` is on goal first: states (N, 5) -> (N,).

    0 where the finger is on the goal already; inf where the goal is out of reach.
    At most 32: no joint is more than pi away, and it turns 0.1 rad in a step.
    It is the smallest number of steps that any policy needs, up to the 5 px between
    the points that the reference looks at: about one start in eighty could be reached
    one step earlier. So regret against it can be -1, but seldom.
    """
    states = np.array(np.atleast_2d(states), np.float64)
    steps = np.where(_on_goal(_gap(states)), 0.0, np.inf)
    for n in range(1, math.ceil(math.pi / TURN) + 1):
        under_way = np.flatnonzero(np.isinf(steps))
        if not len(under_way):
            break
        moving = states[under_way]
        moving, _, _ = step(moving, reference_action(moving))
        states[under_way] = moving
        steps[under_way[moving[:, 4] > 0]] = n
    return steps


def _lands_on_goal(states, actions):
    """Is the finger on goal after this action? (N, 5), (N, 2) -> (N,) bool."""
    return _on_goal(_gap(step(states, actions)[0]))


def _points_of_goal(states):
    """Points of the goal square, px from the base, nearest its centre first: (N, P, 2).

    A grid of 9 x 9, and the one point that is nearest to the base: for some goals
    drawn in the window it is the only one within reach.
    """
    inside = GOAL_HALF - 0.01  # px: on the very edge, rounding could decide
    side = np.linspace(-inside, inside, 9)
    grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    grid = grid[np.argsort(np.hypot(grid[:, 0], grid[:, 1]), kind="stable")]
    goal = states[:, 2:4] - BASE
    nearest = goal - np.clip(goal, -inside, inside)
    return np.concatenate([goal[:, None] + grid, nearest[:, None]], axis=1)


def _towards(states, points):
    """The action towards the point that the finger reaches first, (N, P, 2) -> (N, 2).

    Among points that take equally many whole steps, the first of the list. What is
    one step away and what is nearer count the same: both take one step.
    """
    turns = inverse_kinematics(points) - states[:, None, None, :2]
    turns = np.remainder(turns + math.pi, FULL_TURN) - math.pi  # the short way round
    # The slower joint decides, in whole steps. A hair less than the quotient, so that
    # rounding does not make a fourth step of exactly three
    steps = np.ceil(np.abs(turns).max(axis=3) / TURN - 1e-9)  # (N, P, branch)
    steps = np.maximum(steps, 1.0)
    radius = np.hypot(points[..., 0], points[..., 1])
    # Out of reach: the last choice, and then the least far one
    steps += np.where(radius > REACH, 1000.0 * radius, 0.0)[..., None]
    best = steps.reshape(len(states), -1).argmin(axis=1)
    turns = turns.reshape(len(states), -1, 2)[np.arange(len(states)), best]
    return np.clip(turns / TURN, -1.0, 1.0)


# --------------------------------------------------------------- the Gymnasium task


class Arm(gym.Env):
    """The Arm as a Gymnasium environment: `gym.make("ArmEasy-v0")`, `"ArmHard-v0"`.

    goal: "easy" (always at (100, 100) px) or "hard" (drawn anew at each reset).
    goal_area: where hard goals are drawn, "reachable" or "window".
    reward: "distance" or "distance_and_bonus".
    success_terminates: what success does to the episode. False: `truncated=True`, the
        clock stops and the world goes on, so a target still bootstraps. True:
        `terminated=True`, the world ends and nothing is earned after it.
    render_mode: None, "human" or "rgb_array".
    Raises ValueError for any other option.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 30}

    def __init__(
        self,
        goal="easy",
        goal_area="reachable",
        reward="distance",
        success_terminates=False,
        render_mode=None,
    ):
        _check_option("goal", goal, GOALS)
        _check_option("goal_area", goal_area, GOAL_AREAS)
        _check_option("reward", reward, REWARDS)
        _check_option("success_terminates", success_terminates, (False, True))
        _check_option("render_mode", render_mode, (None, "human", "rgb_array"))
        self.goal = goal
        self.goal_area = goal_area
        self.reward = reward
        self.success_terminates = success_terminates
        self.render_mode = render_mode
        # The largest values by geometry: elbow 100 / 200, finger 200 / 200, goal to
        # elbow (200 + 100) / 400, goal to finger (200 + 200) / 400, flag 1
        high = np.array([0.5, 0.5, 1, 1, 0.75, 0.75, 1, 1, 1], np.float32)
        low = -high
        low[8] = 0.0
        self.observation_space = gym.spaces.Box(low, high, dtype=np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._states = None  # (1, 5), or None before the first reset
        self._screen = None
        self._clock = None

    @property
    def state(self):
        """(joint 1, joint 2, goal x, goal y, counter): radians, px, steps.

        (5,) float64; it can be set. ValueError for anything but five finite numbers,
        for a goal outside the window, and for a negative counter.
        """
        self._check_started()
        return self._states[0].copy()

    @state.setter
    def state(self, value):
        value = np.array(value, np.float64)
        if value.shape != (5,) or not np.all(np.isfinite(value)):
            raise ValueError(
                "state: expected 5 finite numbers (joint 1, joint 2, goal x, goal y, "
                f"counter), got {value}"
            )
        if np.any(value[2:4] < 0.0) or np.any(value[2:4] > WINDOW) or value[4] < 0:
            raise ValueError(
                f"state: the goal must lie in the window (0 to {WINDOW:g} px) and the "
                f"counter must not be negative, got {value}"
            )
        self._states = value[None]

    def reset(self, *, seed=None, options=None):
        """Begin an episode → obs (9,), and info with "success" and "on_goal".

        `seed` as in Gymnasium; there are no `options`.
        """
        super().reset(seed=seed)
        self._states = start_states(self.np_random, 1, self.goal, self.goal_area)
        obs = observe(self._states)[0]
        if self.render_mode == "human":
            self.render()
        return obs, {"success": False, "on_goal": bool(obs[8])}

    def step(self, action):
        """One turn of both joints, action (2,) in [-1, 1]; larger ones are clipped.

        Returns obs (9,), reward, terminated, truncated, info, as in Gymnasium.
        """
        self._check_started()
        actions = np.asarray(action, np.float64).reshape(1, 2)
        self._states, rewards, success = step(self._states, actions, self.reward)
        obs = observe(self._states)[0]
        success = bool(success[0])
        terminated = success and self.success_terminates
        truncated = success and not self.success_terminates
        if self.render_mode == "human":
            self.render()
        info = {"success": success, "on_goal": bool(obs[8])}
        return obs, float(rewards[0]), terminated, truncated, info

    def render(self):
        """A (400, 400, 3) uint8 picture, or a window on the screen; y points up."""
        if self.render_mode is None:
            gym.logger.warn(
                "render() was called without a render mode: give one to gym.make, "
                'for example render_mode="rgb_array"'
            )
            return None
        self._check_started()
        pygame = _import_pygame()
        picture = _draw(pygame, self._states)
        if self.render_mode == "rgb_array":
            return np.transpose(pygame.surfarray.array3d(picture), (1, 0, 2)).copy()
        if self._screen is None:
            pygame.display.init()
            self._screen = pygame.display.set_mode((int(WINDOW), int(WINDOW)))
            pygame.display.set_caption("Arm")
            self._clock = pygame.time.Clock()
        self._screen.blit(picture, (0, 0))
        pygame.event.pump()
        self._clock.tick(self.metadata["render_fps"])
        pygame.display.flip()
        return None

    def close(self):
        """Close the window, if there is one."""
        if self._screen is not None:
            pygame = _import_pygame()
            pygame.display.quit()
            pygame.quit()
            self._screen = None
            self._clock = None

    def _check_started(self):
        if self._states is None:
            raise gym.error.ResetNeeded("Arm: call reset() first")


def _check_option(field, value, allowed):
    """Refuse a wrong option: field, value, what is allowed, the nearest spelling."""
    # `is`, so that 0 does not pass for False; strings are compared by value
    if any(value is a or (isinstance(a, str) and value == a) for a in allowed):
        return
    words = {str(a): repr(a) for a in allowed}
    near = difflib.get_close_matches(str(value), words, n=1, cutoff=0.5)
    hint = f"; did you mean {words[near[0]]}?" if near else ""
    listed = ", ".join(words.values())
    raise ValueError(f"{field}={value!r} is not possible: allowed are {listed}{hint}")


# ------------------------------------------------------------------------- drawing


def _import_pygame():
    try:
        import pygame
    except ImportError as error:
        raise DependencyNotInstalled(
            "pygame is not installed, and the Arm cannot be drawn without it: "
            'run `pip install "gymnasium[classic-control]"`'
        ) from error
    return pygame


FINE = 3  # drawn this many times too large, then made smaller: smooth edges
PAPER_WHITE = (250, 250, 248)
REACH_GREY = (240, 241, 239)
GOAL_BLUE = (86, 156, 214)
GOAL_DARK = (0, 90, 160)
LINK_NEAR = (96, 104, 112)
LINK_FAR = (150, 158, 166)
JOINT_DARK = (45, 50, 56)
FINGER_ORANGE = (213, 94, 0)


def _draw(pygame, states):
    """Draw one state, (1, 5), on a new surface of 400 x 400 px."""
    _, _, goal_x, goal_y, counter = states[0]
    on_goal = bool(_on_goal(_gap(states))[0])
    base = _to_screen(BASE, BASE)
    elbow, finger = (_to_screen(*(BASE + p)) for p in locate(states[:, :2])[0])

    large = pygame.Surface((int(WINDOW) * FINE, int(WINDOW) * FINE))
    large.fill(PAPER_WHITE)
    pygame.draw.circle(large, REACH_GREY, base, int(REACH) * FINE)

    side = 2 * int(GOAL_HALF) * FINE
    square = pygame.Rect(0, 0, side, side)
    square.center = _to_screen(goal_x, goal_y)
    pygame.draw.rect(large, GOAL_BLUE, square, border_radius=3 * FINE)
    if on_goal:
        pygame.draw.rect(large, GOAL_DARK, square, 3 * FINE, border_radius=3 * FINE)
    pygame.draw.circle(large, GOAL_DARK, square.center, 2 * FINE)

    _draw_link(pygame, large, LINK_NEAR, base, elbow, width=14 * FINE)
    _draw_link(pygame, large, LINK_FAR, elbow, finger, width=14 * FINE)
    for place, radius in ((base, 11), (elbow, 7)):
        pygame.draw.circle(large, JOINT_DARK, place, radius * FINE)
        pygame.draw.circle(large, PAPER_WHITE, place, (radius - 4) * FINE)
    pygame.draw.circle(large, FINGER_ORANGE, finger, 6 * FINE)

    picture = pygame.transform.smoothscale(large, (int(WINDOW), int(WINDOW)))
    pygame.font.init()
    font = pygame.font.Font(None, 20)
    text = font.render(f"on goal {int(counter)} / {HOLD + 1}", True, JOINT_DARK)
    picture.blit(text, (10, 10))
    return picture


def _to_screen(x, y):
    """Window px (y up) to px of the large surface (y down), as whole numbers."""
    return round(x * FINE), round((WINDOW - y) * FINE)


def _draw_link(pygame, surface, colour, start, end, width):
    """A bar with round ends; pygame's own thick lines have slanted ones."""
    (x0, y0), (x1, y1) = start, end
    length = math.hypot(x1 - x0, y1 - y0)
    half_x = (y0 - y1) / length * width / 2  # half the width, across the link
    half_y = (x1 - x0) / length * width / 2
    corners = [
        (x0 + half_x, y0 + half_y),
        (x1 + half_x, y1 + half_y),
        (x1 - half_x, y1 - half_y),
        (x0 - half_x, y0 - half_y),
    ]
    pygame.draw.polygon(surface, colour, corners)
    pygame.draw.circle(surface, colour, start, width // 2)
    pygame.draw.circle(surface, colour, end, width // 2)
