"""Recording and replaying the order of results repeats an asynchronous run bit for bit."""

from __future__ import annotations

import pickle
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import Mock

import numpy as np
import pytest
from collecting.scripted import Disturbed, Tickets, scripted_group
from group import sample_envs
from hypothesis import assume, given
from hypothesis import strategies as st

import rlightning_aio as rl
from rlightning_aio import sync
from rlightning_aio._core.group.drivers.sync_driver import SyncDriver
from rlightning_aio.collecting import Collector
from rlightning_aio.collecting.record import Record, RecordedGroup, RecordFile, ReplayedGroup
from rlightning_aio.errors import EnvFault, EnvRaised, RLightningError

if TYPE_CHECKING:
    from rlightning_aio.batch import BatchedData
    from rlightning_aio.collecting import Rollout

assert sample_envs  # Registers its envs.

POLE = {"name": "pole", "backend": "gymnasium", "task": "CartPole-v1", "num_workers": 4}


class Learner:
    """A softmax over linear scores, and the policy gradient of its advantages."""

    def __init__(self) -> None:
        self.weights = np.zeros((4, 2), np.float32)
        self.generator = np.random.default_rng(5)

    def __call__(self, batch: BatchedData) -> dict[str, Any]:
        share = self._shares(batch.observation)[:, 1]
        return {"action": (self.generator.random(len(batch)) < share).astype(int)}

    def _shares(self, observation: Any) -> Any:
        scores = np.exp(observation @ self.weights)
        return scores / scores.sum(axis=1, keepdims=True)

    def learn(self, rollout: Rollout) -> None:
        values = np.zeros(len(rollout), np.float32)
        advantages = rollout.advantages(values, np.zeros(len(rollout.ends)), 0.99, 0.95)
        chosen = np.eye(2, dtype=np.float32)[rollout.action]
        direction = (chosen - self._shares(rollout.observation)) * advantages[:, None]
        self.weights += 0.01 * rollout.observation.T @ direction / len(rollout)


async def trained(group: Any, **order: Any) -> Any:
    """Weights after some asynchronous updates, and their rollouts."""
    learner, seen = Learner(), []
    with group.auto_reset():
        collector: Any = Collector(group, learner, num_transitions=60, seed=3, **order)
        for _ in range(6):
            rollout = await collector.collect()
            learner.learn(rollout)
            collector.policy_version += 1
            seen.append((rollout.index.tolist(), rollout.observation.copy(), rollout.lag.tolist()))
    return learner.weights, seen


@pytest.mark.one_driver_for_each_place
async def test_an_asynchronous_training_is_repeated_bit_for_bit(tmp_path: Path) -> None:
    """Including weights; first in workers, then in this process, where the order differs."""
    async with rl.build_env_group({**POLE, "envs_per_process": 2}) as group:
        weights, seen = await trained(group, record=tmp_path / "order")
    assert 0 < (tmp_path / "order").stat().st_size < 100 + 6 * 70 + 4 * 2 * (6 * 60 + 50)
    for placement in ("process", "inline"):
        async with rl.build_env_group({**POLE, "placement": placement}) as group:
            again, seen_again = await trained(group, replay=tmp_path / "order")
        assert weights.any()
        assert weights.tobytes() == again.tobytes()
        for one, other in zip(seen, seen_again, strict=True):
            assert one[0] == other[0]
            assert one[1].tobytes() == other[1].tobytes()
            assert one[2] == other[2]


@given(st.integers(0, 2**32 - 1), st.sampled_from(["single", "vector"]), st.integers(1, 4))
def test_any_order_can_be_replayed(seed: int, kind: str, min_results: int) -> None:
    generator = np.random.default_rng(seed)

    def collected(in_front: Any) -> tuple[list[Any], Any]:
        group, logs = scripted_group(kind, 4, 0.2)
        with group, group.auto_reset(10**6):
            chosen = in_front(group, logs)
            collector: Any = Collector(
                chosen, Tickets(), num_transitions=7, min_results=min_results
            )
            found = [collector.collect() for _ in range(4)]
            return [(r.index.copy(), r.action.copy(), r.end_observation) for r in found], chosen

    def disturbed(group: Any, logs: Any) -> Any:
        def choose(count: int) -> int:
            return int(generator.integers(count))

        return RecordedGroup(
            Disturbed(group, logs, choose, loses=lambda: False, interrupts=lambda: False)  # type: ignore[arg-type]
        )

    first, recorded = collected(disturbed)
    record = pickle.loads(pickle.dumps(recorded.record))
    second, _ = collected(lambda group, _: ReplayedGroup(group, record))
    for (*one, _), (*other, _) in zip(first, second, strict=True):
        assert all(map(np.array_equal, one, other))


def recorded_calls(count: int) -> Record:
    """A record of two envs that are stepped in turn."""
    with sync.build_env_group({**POLE, "num_workers": 2, "placement": "inline"}) as group:
        recorded = RecordedGroup(group)
        batch, _ = recorded.reset(seed=0)
        recorded.step_async(batch.respond(action=[0, 0]))
        for _ in range(count):
            batch, _ = recorded.collect_async(None, False, 1, 1)
            recorded.step_async(batch.respond(action=[0]))
    return recorded.record


def test_a_replay_names_the_call_at_which_it_differs() -> None:
    record = recorded_calls(3)
    with sync.build_env_group({**POLE, "num_workers": 2, "placement": "inline"}) as group:
        replayed = ReplayedGroup(group, record)
        batch, _ = replayed.reset(seed=0)
        replayed.step_async(batch.respond(action=[0, 0]))
        batch, _ = replayed.collect_async(wait_all=True)
        assert batch.ids() == ["pole-0"]  # As recorded.
        assert replayed.pending == ["pole-1"]
        batch, _ = replayed.collect_async()
        assert batch.ids() == ["pole-1"]
        assert replayed.pending == []
        with pytest.raises(RLightningError, match=r"call 3 .*of 3.*'pole-0'.*no request to answer"):
            replayed.collect_async()
        group.reset_async(env_ids=["pole-0"])
        with pytest.raises(RLightningError, match=r"'pole-0'.*was a step, and is a reset now"):
            replayed.collect_async()


def test_a_replay_ends_with_its_record() -> None:
    with sync.build_env_group({**POLE, "placement": "inline"}) as group:
        replayed = ReplayedGroup(group, Record())
        with pytest.raises(RLightningError, match="ends after 0 calls"):
            replayed.collect_async()


def test_errors_are_raised_in_the_recorded_order() -> None:
    entry = {"name": "probe", "backend": "probe", "task": "-", "num_workers": 2}
    record = None
    for _ in range(2):
        with sync.build_env_group({**entry, "placement": "inline"}) as group:
            chosen: Any = RecordedGroup(group) if record is None else ReplayedGroup(group, record)
            batch, _ = chosen.reset()
            chosen.step_async(batch.respond(action=np.array([[3.0, 0.0], [0.0, 1.0]])))
            with pytest.raises(EnvRaised):
                chosen.collect_async(min_results=2)
            batch, _ = chosen.collect_async()
            assert batch.reward.tolist() == [1.0]
            record = getattr(chosen, "record", None)


def test_entries_with_different_numbers_of_sub_environments_are_recorded() -> None:
    """In one group, and replayed in the recorded order."""
    entries = [
        {**POLE, "name": f"of {k}", "num_envs": k, "num_workers": 2, "placement": "inline"}
        for k in (1, 2, 3)
    ]
    record, orders = Record(), []
    for _ in range(2):
        with sync.build_env_group(entries) as group:
            chosen: Any = ReplayedGroup(group, record) if orders else RecordedGroup(group)
            group.reset_async(seed=0)
            order = []
            for count in (1, 2, 3):
                batch, flags = chosen.collect_async(min_results=count, max_results=count)
                order.append(list(zip(batch.env_ids(), flags, strict=True)))
            record = getattr(chosen, "record", record)
            orders.append(order)
    assert list(map(len, orders[0])) == [1, 2, 3]
    assert orders[0] == orders[1]


@pytest.mark.parametrize("error", [MemoryError, KeyboardInterrupt])
def test_results_that_could_not_be_recorded_come_with_the_next_call(
    error: type[BaseException], monkeypatch: pytest.MonkeyPatch
) -> None:
    """And are recorded then, once."""
    with sync.build_env_group({**POLE, "num_workers": 2, "placement": "inline"}) as group:
        recorded: Any = RecordedGroup(group)
        batch, _ = recorded.reset(seed=0)
        recorded.step_async(batch.respond(action=[0, 1]))
        with monkeypatch.context() as patched:
            patched.setattr(recorded.record, "note", Mock(side_effect=error))
            with pytest.raises(error):
                recorded.collect_async()
        assert sorted(recorded.pending) == ["pole-0", "pole-1"]
        found = [recorded.collect_async()[0].env_ids() for _ in range(2)]
        assert sorted(found) == [["pole-0"], ["pole-1"]]
        assert recorded.pending == []
        assert recorded.record.num_calls == 2


def test_an_error_that_could_not_be_recorded_comes_with_the_next_call() -> None:
    wrapped = Mock(pending=[], _driver=SyncDriver())
    fault = EnvFault("it raised", env_id="a-0")
    wrapped.collect_async.side_effect = fault
    recorded: Any = RecordedGroup(wrapped)
    note, recorded.record.note = recorded.record.note, Mock(side_effect=MemoryError)
    with pytest.raises(MemoryError):
        recorded.collect_async()
    assert recorded.pending == ["a-0"]
    recorded.record.note = note
    with pytest.raises(EnvFault) as raised:
        recorded.collect_async()
    assert raised.value is fault
    assert recorded.record.num_calls == wrapped.collect_async.call_count == 1


def test_a_replay_has_the_deadline_of_the_call_however_it_is_given() -> None:
    wrapped = Mock(_driver=SyncDriver())
    wrapped.collect_async.side_effect = TimeoutError
    replayed: Any = ReplayedGroup(wrapped, RECORD)
    for arguments, options in (((None, False, None, None, 3.0), {}), ((), {"deadline": 3.0})):
        with pytest.raises(TimeoutError):
            replayed.collect_async(*arguments, **options)
        assert wrapped.collect_async.call_args.kwargs["deadline"] == 3.0
    with pytest.raises(TypeError, match="dead_line"):
        replayed.collect_async(dead_line=3.0)


def test_a_file_with_other_content_raises(tmp_path: Path) -> None:
    path = tmp_path / "notes"
    path.write_text("shopping list")
    with pytest.raises(ValueError, match=r"record in .*notes can't be replayed: it doesn't start"):
        Record.load(path)


RECORD = Record()
for calls in ([("a-0", 1), ("b-1", 0)], [("a-0", 0)], [("b-1", 2)], [("a-0", 3)]):
    RECORD.note(calls)


def sealed(record: Record) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        RecordFile(record, path := Path(folder, "order")).write()
        return path.read_bytes()


def load(data: bytes) -> Record:
    with tempfile.NamedTemporaryFile() as file:
        Path(file.name).write_bytes(data)
        return Record.load(file.name)


@pytest.mark.parametrize("record", [Record(), RECORD], ids=["empty", "of two envs"])
def test_a_saved_record_is_loaded_unchanged(record: Record) -> None:
    assert vars(load(sealed(record))) == vars(record)


def test_a_record_that_grows_is_added_to_its_file(tmp_path: Path) -> None:
    """Also where a write failed before, and wrote a part."""
    record = Record()
    file = RecordFile(record, tmp_path / "order")
    for k in range(3):
        record.note([(f"a-{k}", 1), ("a-0", 0)])
        file.write()
        file.write()
        assert vars(Record.load(tmp_path / "order")) == vars(record)
        with (tmp_path / "order").open("ab") as torn:
            torn.write(b"a part")


def test_the_order_of_a_run_that_ends_in_an_error_is_recorded(tmp_path: Path) -> None:
    """So the error can be replayed."""
    entry = {"name": "probe", "backend": "probe", "task": "-", "num_workers": 2}

    def policy(batch: BatchedData) -> Any:
        return np.array(
            [[3.0 * (k == 0 and not batch.is_reset[k]), 1.0] for k in range(len(batch))]
        )

    def run(**order: Any) -> str:
        with sync.build_env_group({**entry, "placement": "inline"}) as group:
            collector: Any = Collector(group, policy, num_transitions=8, **order)
            with pytest.raises(EnvRaised) as raised:
                collector.collect()
            return raised.value.env_id

    path = tmp_path / "order"
    assert run(record=path) == run(replay=path)
    with sync.build_env_group({**entry, "placement": "inline"}) as group:
        with pytest.raises(ValueError, match="record and replay exclude each other"):
            Collector(group, policy, num_transitions=8, record=path, replay=path)
        with pytest.raises(OSError, match="missing"):
            Collector(group, policy, num_transitions=8, record=tmp_path / "missing" / "order")


@given(st.data())
def test_any_damage_to_a_file_raises(data: st.DataObject) -> None:
    """Flipped bits, truncation, extra bytes, or several of these."""
    whole = sealed(RECORD)
    damaged = bytearray(whole)
    for bit in data.draw(st.lists(st.integers(0, 8 * len(whole) - 1), max_size=3, unique=True)):
        damaged[bit // 8] ^= 1 << bit % 8
    del damaged[data.draw(st.integers(0, len(whole))) :]
    damaged += data.draw(st.binary(max_size=3))
    assume(bytes(damaged) != whole)
    with pytest.raises(ValueError, match=r"can't be replayed: it (doesn't start|was changed)"):
        load(bytes(damaged))
