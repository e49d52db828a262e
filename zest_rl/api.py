"""The verbs of the command line as functions with their arguments; ``import zest_rl`` offers them.

A dataset is an id, the path of a file or folder that `zest relabel` takes, or what `collect` or `relabel` returned. A
run is the folder that `train` returned.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, TypeAlias, get_args, overload

from zest_rl.errors import BadInput, nearest

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from zest_rl.agents import Policy
    from zest_rl.analysis.cross_task import JointInspection
    from zest_rl.analysis.curated import Curation
    from zest_rl.data.reader import Dataset
    from zest_rl.evaluation.evaluate import Evaluation
    from zest_rl.explore.serving import ServedPage
    from zest_rl.export import Exported, Format
    from zest_rl.export.push import Upload
    from zest_rl.kitchen.collect import Collected
    from zest_rl.rewards.by_learned import RelabeledByRun
    from zest_rl.rewards.relabel import Relabeled
    from zest_rl.training.request import OnProgress

Progress: TypeAlias = Callable[[int, int], None]
"""Called with (parts done, parts in all)."""


class HasDataset(Protocol):
    """What a verb that writes a dataset returns."""

    @property
    def dataset_id(self) -> str:
        """Id of the dataset."""


AnyDataset: TypeAlias = str | Path | HasDataset


def _id(dataset: AnyDataset) -> str:
    return str(dataset) if isinstance(dataset, str | Path) else dataset.dataset_id


def _configs(given: Mapping[str, Any], *kinds: type[Any]) -> list[Any]:
    """Build configs of these kinds from the arguments of all of them.

    Raises:
        BadInput: an argument is of none, or a value is out of range.
    """
    names = [{field.name for field in fields(kind)} for kind in kinds]
    if unknown := given.keys() - set().union(*names):
        raise BadInput(f"unknown argument {min(unknown)!r}; {nearest(min(unknown), set().union(*names))}")
    return [kind(**{name: given[name] for name in given.keys() & own}) for kind, own in zip(kinds, names, strict=True)]


def collect(
    task: str = "micro", *, n_workers: int | None = None, on_progress: Progress | None = None, **flags: Any
) -> Collected:
    """Collect a dataset of a kitchen task from an imperfect expert; see `zest_rl.kitchen.collect.collect_dataset`.

    Args:
        task: knob2, knob3, ldoor, rdoor, sdoor or micro.
        n_workers: processes, default one per core.
        on_progress: called with (episodes done, episodes in all).
        **flags: the other fields of `zest_rl.kitchen.collect_config.CollectConfig`: n_episodes, noise_max, stop_share,
            slow_max, bias_max, grip_max, level, seed, dataset.
    """
    from zest_rl.kitchen.collect import collect_dataset
    from zest_rl.kitchen.collect_config import CollectConfig

    (config,) = _configs({"task": task, **flags}, CollectConfig)
    return collect_dataset(config, n_workers=n_workers, on_progress=on_progress or (lambda done, total: None))


@overload
def relabel(
    dataset: AnyDataset, goal: str | Path = ..., *, reward: Literal["level", "difference"] = ..., **flags: Any
) -> Relabeled: ...


@overload
def relabel(dataset: AnyDataset, goal: str | Path = ..., *, reward: str | Path, **flags: Any) -> RelabeledByRun: ...


def relabel(
    dataset: AnyDataset, goal: str | Path = "same-scene", *, reward: str | Path = "level", **flags: Any
) -> Relabeled | RelabeledByRun:
    """Write a copy of a dataset whose rewards are ZeST scores; see `zest_rl.rewards.relabel.relabel`.

    Args:
        dataset: any that `zest relabel` takes.
        goal: folder with ``init/`` and ``goal/``, "text:closed drawer -> open drawer", "episode:3", or for the kitchen
            "same-scene", "toys", "text" or "drawings".
        reward: "level", the score after each action; "difference", its change; or what ``train("trex", …)`` returned,
            whose learned rewards are written instead (`zest_rl.rewards.by_learned.relabel_by_run`).
        **flags: frames, camera, env, robot, look_at, views, show_robot, tolerance, skip_incomplete, masks, embedder,
            features, similarity, precision, backend, vectors, goal_share, shuffle, device, n_workers, engine,
            on_start, on_progress; of a learned reward device, n_workers and engine. What `zest relabel --preview`
            draws, `zest_rl.rewards.preview.preview` draws.
    """
    from zest_rl.rewards.by_learned import relabel_by_run
    from zest_rl.rewards.relabel import relabel as relabel_dataset
    from zest_rl.rewards.scores import Reward, check_reward

    check_reward(str(reward))
    if str(reward) not in get_args(Reward):
        return relabel_by_run(_id(dataset), reward, **flags)
    return relabel_dataset(_id(dataset), str(goal), reward=reward, **flags)


def with_rewards(dataset: AnyDataset, rewards: Sequence[ArrayLike], label: str = "given") -> str:
    """Write a copy of a dataset that has rewards of your own, and return its id.

    See `zest_rl.rewards.given.with_rewards`.

    Args:
        dataset: relabeled or not.
        rewards: (T,) of every episode, in order; r_t rewards a_t.
        label: a word that reports and the new id call them by.
    """
    from zest_rl.rewards.given import with_rewards as with_rewards_of_id

    return with_rewards_of_id(_id(dataset), rewards, label)


def inspect(
    *datasets: AnyDataset,
    output: str | Path | None = None,
    n_workers: int | None = None,
    trust: bool = False,
    on_progress: Progress | None = None,
) -> JointInspection:
    """Judge the rewards of relabeled datasets; see `zest_rl.analysis.cross_task.inspect_datasets`.

    Args:
        *datasets: relabeled ones.
        output: also write the HTML page of `zest inspect`.
        n_workers: processes that embed, default one per core.
        trust: load the embedder that a dataset of somebody else names, now and from now on.
        on_progress: called with (parts done, parts in all).
    """
    from zest_rl.analysis.cross_task import inspect_datasets
    from zest_rl.report.html import write_report
    from zest_rl.report.inspection_page import inspection_report

    ids, progress = [_id(dataset) for dataset in datasets], on_progress or (lambda done, total: None)
    inspected = inspect_datasets(ids, n_workers=n_workers, trust=trust, on_progress=progress)
    if output is not None:
        write_report(inspection_report(inspected), Path(output))
    return inspected


def curate(
    dataset: AnyDataset,
    keep: float = 0.8,
    *,
    source: str | Path | None = None,
    output: str | Path | None = None,
    dry_run: bool = False,
) -> Curation:
    """Write a dataset without the episodes that score worst; see `zest_rl.analysis.curated.curate`.

    Args:
        dataset: relabeled.
        keep: share of the episodes to keep.
        source: the robomimic file or LeRobot folder that it was relabeled from, to curate that, too.
        output: the table, a CSV; default DATASET.curated.csv here.
        dry_run: write nothing.
    """
    from zest_rl.analysis.curated import curate as curate_id

    table = None if output is None else Path(output)
    return curate_id(_id(dataset), keep, source=source, output=table, dry_run=dry_run)


def explore(
    *datasets: AnyDataset,
    goal: str | Path | None = None,
    output: str | Path = "goals",
    port: int = 0,
    browser: bool = True,
    **flags: Any,
) -> ServedPage:
    """Open a page on which pictures become the curves of all episodes; it is served meanwhile.

    See `zest_rl.explore.serving.ServedPage`: close it when you are done, or ``wait()`` at the end of a script.

    Args:
        *datasets: any that `zest relabel` takes.
        goal: folder of pictures, or sentences, to begin with.
        output: folder that gets a folder for each goal that is saved.
        port: of 127.0.0.1; 0: any that is free.
        browser: open the page.
        **flags: what is seen, as in `relabel`: frames, camera, env, robot, look_at, views, show_robot, tolerance,
            skip_incomplete, masks, embedder, precision, device, backend, vectors, n_workers.
    """
    import webbrowser

    from zest_rl.explore.background import Choice
    from zest_rl.explore.serving import ServedPage

    def command(verb: str, arguments: Mapping[str, Any]) -> str:
        return f"zest_rl.{verb}({', '.join(f'{name}={value!r}' for name, value in arguments.items())})"

    choices = [Choice(_id(dataset), flags) for dataset in datasets]
    spec = None if goal is None else str(goal)
    page = ServedPage(choices, goal=spec, output=Path(output), port=port, command=command)
    if browser:
        webbrowser.open(page.address)
    return page


class Trainer(NamedTuple):
    """What trains an agent: `zest_rl.training.runs` from data alone, `zest_rl.online.runs` in the environment."""

    train: Callable[..., Path]
    config: type[Any]
    """Of the training; the agent has one of its own."""
    counts: str
    """What is counted: updates or steps."""


def trainer(agent: str) -> Trainer:
    """Return what trains an agent.

    Raises:
        BadInput: there is no such agent.
    """
    from zest_rl.agents.configs import OptimizerConfig, config_of
    from zest_rl.training.request import RunConfig, TrainingConfig

    learns_from_data = issubclass(config_of(agent), OptimizerConfig)

    def train_run(*args: Any, **kwargs: Any) -> Path:
        if learns_from_data:  # either brings a simulator, which help does without
            from zest_rl.training.runs import train
        else:
            from zest_rl.online.runs import train
        return train(*args, **kwargs)

    return Trainer(train_run, *((TrainingConfig, "updates") if learns_from_data else (RunConfig, "steps")))


def train(
    agent: str,
    dataset: AnyDataset,
    *,
    run_dir: str | Path | None = None,
    on_progress: OnProgress | None = None,
    **flags: Any,
) -> Path:
    """Train a policy, or go on with an interrupted run, and return its folder.

    See `zest_rl.training.runs.train`, and for sac, ppo and trpo `zest_rl.online.runs.train`.

    Args:
        agent: bc, dt or rvs; trex, which learns a reward; sac, ppo or trpo, which learn in the dataset's environment.
        dataset: its rewards are the only information about quality.
        run_dir: folder of this run alone; default ``runs/DATASET-AGENT-seedN``.
        on_progress: called after every logged row.
        **flags: the fields of `zest_rl.training.request.TrainingConfig` (n_updates, seed, device, …) and of the agent's
            config (`zest_rl.agents.configs.DTConfig`, …).
    """
    from zest_rl.agents.configs import config_of

    how = trainer(agent)
    agent_config, config = _configs(flags, config_of(agent), how.config)
    folder = None if run_dir is None else Path(run_dir)
    return how.train(agent, _id(dataset), agent_config, config, run_dir=folder, on_progress=on_progress)


def evaluate(
    run: str | Path,
    *,
    score: bool = False,
    videos: bool = False,
    device: str = "cpu",
    n_workers: int | None = None,
    trust: bool = False,
    on_progress: Callable[[int], None] | None = None,
    **flags: Any,
) -> Evaluation:
    """Roll a policy out in the environment of its dataset; see `zest_rl.evaluation.evaluate.evaluate`.

    Args:
        run: what `train` returned, or ``hf://OWNER/NAME``, a run on the Hugging Face Hub.
        score: record ZeST scores even if the policy does not need them.
        videos: write videos of the best, median and worst episode.
        device: where the policy runs.
        n_workers: processes, default one per core.
        trust: run the policy, and load the embedder, that a run of somebody else names, now and from now on.
        on_progress: called with the number of episodes finished since the last call.
        **flags: the fields of `zest_rl.evaluation.evaluate.EvaluationConfig`: n_episodes, seed, rtg, target_quantile,
            env, horizon, success_key.
    """
    from zest_rl.evaluation.evaluate import EvaluationConfig
    from zest_rl.evaluation.evaluate import evaluate as evaluate_run

    (config,) = _configs(flags, EvaluationConfig)
    return evaluate_run(
        run,
        config,
        score=score,
        videos=videos,
        device=device,
        n_workers=n_workers,
        trust=trust,
        on_progress=on_progress,
    )


def report(
    *runs: str | Path,
    output: str | Path = "report.html",
    title: str = "ZeST rewards for offline robot learning",
    trust: bool = False,
) -> Path:
    """Compare evaluated runs of one task in one HTML file, and return its path.

    Args:
        *runs: evaluated; those that differ in their seed alone become one row.
        output: the file.
        title: its headline.
        trust: load the embedder that a dataset of somebody else names, now and from now on.
    """
    from zest_rl.report.comparison_page import compare_runs
    from zest_rl.report.html import write_report

    return write_report(compare_runs([Path(run) for run in runs], title=title, trust=trust), Path(output))


def export(dataset: AnyDataset, to: Format = "npz", output: str | Path | None = None, **flags: Any) -> Exported:
    """Write a dataset in another format; see `zest_rl.export.export`.

    Args:
        dataset: relabeled or not.
        to: npz, d4rl, robomimic, d3rlpy, torchrl, lerobot or lerobot-progress.
        output: the file or folder, which must not exist; default DATASET.FORMAT here.
        **flags: shape, normalise, fps.
    """
    from zest_rl.export import export as export_dataset

    return export_dataset(_id(dataset), to, None if output is None else Path(output), **flags)


def push(
    what: AnyDataset,
    repo_id: str,
    *,
    private: bool = False,
    goal_pictures: bool = False,
    dry_run: bool = False,
    on_start: Callable[[Upload], None] | None = None,
) -> Upload:
    """Upload a dataset or a run to the Hugging Face Hub; see `zest_rl.export.push.push`.

    Args:
        what: a dataset, or the folder that `train` returned.
        repo_id: ``OWNER/NAME``; of a dataset, NAME is the first part of its id.
        private: make a new repository a private one, and refuse one that is public.
        goal_pictures: also upload the pictures of a goal that come from elsewhere: you may publish them.
        dry_run: stop before anything is uploaded.
        on_start: called with what will be uploaded.
    """
    from zest_rl.export.push import push as upload

    return upload(_id(what), repo_id, private=private, goal_pictures=goal_pictures, dry_run=dry_run, on_start=on_start)


def load_policy(run: str | Path, device: str = "cpu", *, trust: bool = False) -> Policy:
    """Return the policy of a finished run, to act with; see `zest_rl.agents.load_policy`.

    Args:
        run: what `train` returned, or ``hf://OWNER/NAME``, a run on the Hugging Face Hub.
        device: where the policy runs.
        trust: run the policy of somebody else, if it is a program, now and from now on.
    """
    from zest_rl.agents import load_policy as load

    return load(run, device, trust=trust)


def open_dataset(dataset: AnyDataset) -> AbstractContextManager[Dataset]:
    """Open a dataset to read its episodes, scores and states; see `zest_rl.data.reader.open_dataset`."""
    from zest_rl.data.reader import open_dataset as open_id

    return open_id(_id(dataset))
