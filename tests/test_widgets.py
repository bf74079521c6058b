"""The panels: what a control does, without a browser."""

import threading
import time

import ipywidgets
import numpy as np
import pytest

from dnddpg_minimal import Config, widgets
from dnddpg_minimal.study import load_study

pytestmark = pytest.mark.slow


def wait_until(holds, seconds=60):
    end = time.monotonic() + seconds
    while not holds() and time.monotonic() < end:
        time.sleep(0.02)
    assert holds()


def test_the_laboratory_shows_the_closed_form_and_follows_its_sliders():
    panel = widgets.maximisation_laboratory(actors=2)
    actors, sigma, _, text, picture = panel.children
    assert "+0.56" in text.value  # 1/sqrt(pi): two actions, one critic
    before = picture.value
    sigma.value = 2.0
    assert "+1.13" in text.value
    assert picture.value != before
    actors.value = 1
    assert "closed form +0.00" in text.value


def test_the_laboratory_refuses_a_quantity_that_it_does_not_have():
    with pytest.raises(ValueError, match="gamma"):
        widgets.maximisation_laboratory(gamma=0.9)


@pytest.mark.parametrize("rule", ["selected", "paired_min"])
def test_the_laboratory_refuses_actors_without_a_critic_of_their_own(rule):
    with pytest.raises(ValueError, match="a critic for each actor"):
        widgets.maximisation_laboratory(rule=rule)
    widgets.maximisation_laboratory(("sigma", "rho"), rule, critics=2, actors=2)


def test_two_sliders_moved_from_two_threads_draw_one_after_the_other():
    inside, most = [], []

    def draw(figure, left, right):
        inside.append(1)
        time.sleep(0.02)
        most.append(len(inside))
        inside.pop()
        return f"{left} {right}"

    sliders = {name: ipywidgets.IntSlider() for name in ("left", "right")}
    panel = widgets.panel("two", sliders, draw)

    def move(slider):
        for slider.value in range(1, 6):
            pass

    threads = [threading.Thread(target=move, args=(s,)) for s in sliders.values()]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(most) == 11 and max(most) == 1
    assert panel.children[2].value == "5 5"


def test_every_control_of_the_explorer_changes_text_and_picture():
    if not load_study("Pendulum-v1", what="weights"):
        pytest.skip("no weights of Pendulum are recorded")
    panel = widgets.error_plane_explorer()
    *controls, text, picture = panel.children
    for control, value in zip(controls, ("DN-DDPG", 1, 4_000, 1.0, 4.0), strict=True):
        before = text.value, picture.value
        control.value = value
        assert text.value != before[0]
        assert picture.value != before[1]
        assert control.description
    assert "DN-DDPG, seed 1, step 4,000" in text.value

    # What was drawn over a kept picture is what a whole new picture would show.
    afresh = widgets.error_plane_explorer()
    for control, like in zip(reversed(afresh.children[:-2]), reversed(controls),
                             strict=True):
        control.value = like.value  # the state first, then what empties the figure
    assert afresh.children[-1].value == picture.value


def test_the_explorer_says_where_recordings_are_missing(tmp_path):
    with pytest.raises(FileNotFoundError, match="study"):
        widgets.error_plane_explorer(folder=tmp_path)


def test_live_training_starts_only_when_asked_and_pauses_and_stops():
    config = Config("Pendulum-v1", "DDPG", steps=100_000, warmup=100, hidden=(16, 16),
                    yield_every=20)
    panel = widgets.live_training(config)
    assert panel.training is None
    assert panel.text.value == "Press start."
    panel.start_button.click()
    wait_until(lambda: panel.progress.value > 200)
    panel.pause_button.click()
    time.sleep(0.5)  # the step that was under way
    paused_at = panel.progress.value
    time.sleep(0.5)
    assert panel.progress.value == paused_at
    panel.pause_button.click()  # go on
    wait_until(lambda: panel.progress.value > paused_at)
    panel.stop_button.click()
    wait_until(lambda: "Over at step" in panel.text.value)
    assert 0 < panel.training.step < config.steps


def test_start_is_heard_right_after_stop_and_pause_forgets_what_it_was():
    config = Config("Pendulum-v1", "DDPG", steps=100_000, warmup=100, hidden=(16, 16),
                    yield_every=20, evaluate_every=100)
    panel = widgets.live_training(config)
    panel.stop_button.click()  # nothing runs yet: nothing happens
    panel.start_button.click()
    wait_until(lambda: panel.progress.value >= 100)
    first = panel.training
    panel.pause_button.click()
    panel.stop_button.click()
    assert panel.pause_button.description == "pause"
    panel.start_button.click()  # while the first run may still be evaluating
    wait_until(lambda: panel.training is not first and panel.progress.value >= 100)
    panel.stop_button.click()


def test_the_panel_refuses_a_run_whose_steps_it_cannot_count():
    with pytest.raises(ValueError, match="give steps instead"):
        widgets.live_training(Config("Pendulum-v1", episodes=3))


def test_a_run_that_breaks_off_says_so_in_the_panel():
    panel = widgets.live_training(Config("NoSuchTask-v0", steps=100))
    panel.start_button.click()
    wait_until(lambda: "broke off" in panel.text.value)
    assert "NoSuchTask-v0" in panel.text.value


def test_every_control_of_the_arm_explorer_changes_text_and_picture():
    if not widgets.recorded_arm_agents():
        pytest.skip("no weights of DN-DDPG on an Arm are recorded")
    panel = widgets.arm_explorer()
    agent, *controls, reward, text, observation, picture = panel.children
    assert "reward" in reward.value
    for control, value in zip(controls, (2.0, 3.0, 300.0, 250.0), strict=True):
        before = text.value, observation.value, picture.value
        control.value = value
        assert text.value != before[0]
        assert observation.value != before[1]
        assert picture.value != before[2]
        assert control.description
    assert "Actor 1 turns" in text.value and "Q1" in text.value
    for name in agent.options:
        agent.value = name  # every recorded agent can be looked at


def test_the_arm_explorer_shows_the_reward_and_the_actor_that_acts():
    agents = widgets.recorded_arm_agents()
    if not agents:
        pytest.skip("no weights of DN-DDPG on an Arm are recorded")
    agent = next(iter(agents.values()))
    state = np.array([[0.0, 0.0, 300.0, 200.0, 0.0]])  # straight to the right
    seen = widgets.look_at_arm(agent, state)
    assert seen["distance"] == pytest.approx(100)  # finger at x = 400, goal at 300
    assert seen["reward"] == pytest.approx(-0.25)
    acts = seen["actions"][seen["chosen"]]
    np.testing.assert_allclose(acts, agent.act(seen["obs"]), atol=1e-6)
    assert seen["paths"].shape == (2, widgets.WAY + 1, 2)
    np.testing.assert_allclose(seen["paths"][:, 0], 2 * [[200, 0]], atol=1e-9)


def test_the_arm_explorer_says_where_recordings_are_missing(tmp_path):
    with pytest.raises(FileNotFoundError, match="study"):
        widgets.arm_explorer(folder=tmp_path)


def test_every_menu_of_the_figure_6_explorer_changes_text_or_picture():
    panel = widgets.figure_6_explorer()
    *menus, text, drawn, picture = panel.children
    assert [menu.description for menu in menus] == ["task", "axis", "interval", "score"]
    assert "Pendulum-v1, n = " in text.value and "not distinguishable" in text.value
    for menu in menus[1:]:
        for option in menu.options[1:]:
            before = drawn.value, picture.value
            menu.value = option
            assert drawn.value != before[0], (menu.description, option)
            assert picture.value != before[1], (menu.description, option)


def test_the_figure_6_explorer_says_which_command_records_a_missing_task(tmp_path):
    panel = widgets.figure_6_explorer(folder=tmp_path)
    task, *_, text, _, _ = panel.children
    task.value = "Hopper-v5"
    assert "python -m dnddpg_minimal study --task Hopper-v5" in text.value
