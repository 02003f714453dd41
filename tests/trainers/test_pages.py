"""Examples for trainers of language models, with the real trainer."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import rlightning_aio as rl

pytestmark = [pytest.mark.simulators, pytest.mark.filterwarnings("ignore")]

EXAMPLES = Path(__file__).parents[2] / "examples"


def test_trl(tmp_path: Path) -> None:
    """Half of the rollouts reach their sum; what the env says is masked."""
    pytest.importorskip("trl")
    names = runpy.run_path(str(EXAMPLES / "trl_grpo.py"))
    from datasets import Dataset
    from trainers.tiny import tiny_model, tokenizer, trainer_args

    words = tokenizer()
    asked: list[int] = []

    async def generate(ids: list[int]) -> tuple[list[int], list[float]]:
        asked.append(len(ids))
        text = "x1y" if len(asked) % 2 else "xy"
        return words.encode(text), [-1.0] * len(text)

    trainer = names["train"](
        generate,
        words,
        model=tiny_model(words),
        args=trainer_args(tmp_path),
        train_dataset=Dataset.from_list([{"prompt": f"Pay 1, {one}"} for one in "abcd"]),
    )
    first, second = [row for row in trainer.state.log_history if "loss" in row]
    assert {*asked} == {8, 8 + 3 + 3, 8 + 2 + 3}
    assert 0 < first["reward"] < 2
    assert first["num_tokens"] < second["num_tokens"]
    assert first["grad_norm"] > 0


async def test_tinker_cookbook() -> None:
    """Half of the attempts at each question are right; one at the second question has failed."""
    pytest.importorskip("tinker_cookbook")
    names = runpy.run_path(str(EXAMPLES / "tinker_groups.py"))
    import tinker
    from tinker_cookbook.completers import TokensWithLogprobs

    asked: list[str] = []

    async def policy(seen: Any, stop: Any) -> Any:
        assert stop == ["\n"]
        asked.append(bytes(seen.to_ints()).decode())
        if asked.count("Is 3 odd?") == 4:
            asked.append("")
            raise rl.EnvError("no model", blame="policy")
        text = b"Yes" if asked.count(asked[-1]) % 2 else b"No."
        return TokensWithLogprobs(tokens=[*text], maybe_logprobs=[-1.0] * 3)

    data, groups = await names["data_of_update"](
        policy,
        lambda text: tinker.ModelInput.from_ints([*text.encode()]),
        lambda tokens: bytes(tokens).decode(),
        ["\n"],
        seeds=[1, 3],
    )
    assert len(data) == len(groups) == 7
    advantages = [datum.loss_fn_inputs["advantages"].data for datum in data]
    last = sorted(round(row[-1], 2) for row in advantages)
    assert last == [-0.67, -0.5, -0.5, 0.33, 0.33, 0.5, 0.5]
    assert all(row[:-3] == [0.0] * (len(row) - 3) for row in advantages)


async def test_verl(monkeypatch: pytest.MonkeyPatch) -> None:
    """A batch of verl's own worker: a rollout whose env has raised is played on another one."""
    pytest.importorskip("verl")
    import numpy as np
    from omegaconf import OmegaConf
    from trainers.tiny import tokenizer
    from verl.experimental.agent_loop import AgentLoopWorker
    from verl.protocol import DataProto
    from verl.utils.dataset.rl_dataset import RLHFDataset
    from verl.workers.rollout.replica import TokenOutput

    monkeypatch.syspath_prepend(EXAMPLES)
    import verl_loop

    words = tokenizer()
    words.chat_template = (
        "{% for one in messages %}<{{ one.role }}>{{ one.content }}{% endfor %}"
        "{% if add_generation_prompt %}<assistant>{% endif %}"
    )
    asked: list[str] = []

    class Server:
        async def generate(self, *, request_id: str, prompt_ids: Any, sampling_params: Any) -> Any:
            assert request_id
            assert sampling_params["temperature"] == 0.7
            asked.append(words.decode(prompt_ids))
            text = "broken" if len(asked) == 1 else "x1" if "Reach 2." in asked[-1] else "x"
            return TokenOutput(token_ids=words.encode(text), log_probs=[-0.5] * len(text))

    async def step(self: Any, text: str) -> Any:
        if text == "broken":
            raise OSError("the sandbox is gone")
        return await own_step(self, text)

    own_step = verl_loop.Till.step
    monkeypatch.setattr(verl_loop.Till, "step", step)
    rollout = {"prompt_length": 40, "response_length": 32, "calculate_log_probs": True}
    sampling = {"temperature": 0.7, "top_p": 1.0, "top_k": -1}
    config = {"actor_rollout_ref": {"rollout": {**rollout, **sampling}}, "data": {}}
    worker: Any = object.__new__(AgentLoopWorker)  # Its constructor loads a model from a folder.
    worker.config = OmegaConf.create(config)
    worker.rollout_config = worker.config.actor_rollout_ref.rollout
    worker.llm_client, worker.tokenizer, worker.processor = Server(), words, None
    worker.hf_model_type, worker.dataset_cls, worker.tools = None, RLHFDataset, []
    worker.reward_loop_worker_handles, worker.distillation_enabled = None, False
    worker.mm_processor_kwargs = {}
    prompts = np.empty(2, object)
    prompts[:] = [[{"role": "user", "content": "Add."}]] * 2
    columns = {"raw_prompt": prompts, "index": np.array([1, 3]), "agent_name": ["till"] * 2}
    found = (await worker.generate_sequences(DataProto.from_dict(non_tensors=columns))).batch
    group, _ = await verl_loop.envs()
    await group.close()
    verl_loop.envs.cache_clear()
    text = "x1<user>1<assistant>x1", "x<user>0<assistant>x"
    for ids, expected in zip(found["responses"], text, strict=True):
        assert words.decode(ids[: len(expected)]) == expected
    masks = [1] * 2 + [0] * 18 + [1] * 2, [1] + [0] * 18 + [1]
    assert [row.tolist() for row in found["response_mask"]] == [
        mask + [0] * (32 - len(mask)) for mask in masks
    ]
    assert [row.sum().item() for row in found["rm_scores"]] == [1.0, 0.0]
    assert found["rollout_log_probs"].sum().item() == -0.5 * 6
    assert asked[-1].startswith("<user>Add.<user>Reach")
    assert len(asked) == 5  # One of them for the rollout that was played again.


@pytest.mark.asyncio(loop_factories=["asyncio"])  # verifiers leaves a descriptor on the other one.
async def test_verifiers(monkeypatch: pytest.MonkeyPatch) -> None:
    """One episode ends with its reward, and one whose env raises with an error and without."""
    vf = pytest.importorskip("verifiers.v1")
    from aiohttp import ClientSession, web
    from aiohttp.test_utils import TestServer
    from verifiers.v1.dialects.chat import message_to_wire
    from verifiers.v1.runtimes import ProgramResult
    from verifiers.v1.utils.loaders import load_environment, resolve_env_config

    class Talker(vf.Harness[vf.HarnessConfig]):
        """Asks the model once, in this process; verifiers' own harnesses are programs."""

        SUPPORTS_RESUME, NEEDS_CONTAINER, EXECUTES_CODE = True, False, False

        async def launch(
            self,
            ctx: Any,
            trace: Any,
            runtime: Any,
            endpoint: str,
            secret: str,
            urls: Any,
            data: Any,
        ) -> Any:
            body = {"model": ctx.model, "messages": [message_to_wire(one) for one in data.prompt]}
            key = {"Authorization": f"Bearer {secret}"}
            async with ClientSession(raise_for_status=True) as session:
                await session.post(f"{endpoint}/chat/completions", json=body, headers=key)
            return ProgramResult(exit_code=0, stdout="", stderr="")

    async def complete(request: web.Request) -> web.Response:
        seen = [one["content"] for one in (await request.json())["messages"]]
        asked.append(seen)
        message = {"role": "assistant", "content": "1" if seen[0] == "Reach 2." else "broken"}
        choice = {"index": 0, "message": message, "finish_reason": "stop"}
        about = {"id": "1", "object": "chat.completion", "created": 1, "model": "tiny"}
        return web.json_response({**about, "choices": [choice]})

    async def step(self: Any, text: str) -> Any:
        if text == "broken":
            raise OSError("the sandbox is gone")
        return await own_step(self, text)

    asked: list[list[str]] = []
    monkeypatch.syspath_prepend(EXAMPLES)
    import verifiers_env

    own_step = verifiers_env.Till.step
    monkeypatch.setattr(verifiers_env.Till, "step", step)
    monkeypatch.setitem(sys.modules, "talker", SimpleNamespace(Talker=Talker, __all__=["Talker"]))
    player = {"harness": {"id": "talker"}, "runtime": {"type": "subprocess"}}
    env = load_environment(
        resolve_env_config({"taskset": {"id": "verifiers_env"}, "player": player})
    )
    app = web.Application()
    app.router.add_post("/v1/chat/completions", complete)
    async with TestServer(app) as server, env.serving():
        client = vf.EvalClientConfig(base_url=str(server.make_url("/v1")), api_key_var="NONE")
        context = vf.ModelContext("tiny", client)
        good, lost = [
            await env.run_episode(task, context) for task in env.taskset.include(idx=["1:3"])
        ]
    assert good.ok
    assert good.traces[0].reward == 1.0
    assert asked == [["Reach 2."], ["Reach 2.", "1", "1"], ["Reach 3."]]
    assert [one.type for one in lost.traces[0].errors] == ["EnvRaisedOSError"]
    assert (lost.ok, lost.traces[0].rewards) == (False, {})
