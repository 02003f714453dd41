"""A tiny language model with random weights, and TRL's trainer, whose model calls given tools."""

from __future__ import annotations

import json
from collections import deque
from pathlib import Path
from typing import Any

import trl
from tokenizers import Tokenizer, decoders, models, pre_tokenizers
from transformers import LlamaConfig, LlamaForCausalLM, PreTrainedTokenizerFast

__all__ = ["ScriptedTrainer", "tiny_model", "trainer_args", "trainer_of"]

Script = list[list[tuple[str, dict[str, Any]]]]
"""The calls of each rollout of a batch, one a turn."""


def tokenizer() -> PreTrainedTokenizerFast:
    """A token for each byte, and Qwen 3's template, whose tool calls TRL knows."""
    letters = sorted(pre_tokenizers.ByteLevel.alphabet())
    special = ["<|endoftext|>", "<|im_start|>", "<|im_end|>"]
    words = {word: number for number, word in enumerate(special + letters)}
    made = Tokenizer(models.BPE(vocab=words, merges=[]))
    made.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    made.decoder = decoders.ByteLevel()
    made.add_special_tokens(special)
    found = PreTrainedTokenizerFast(
        tokenizer_object=made, eos_token="<|im_end|>", pad_token="<|endoftext|>"
    )
    templates = Path(trl.__file__).parent / "chat_templates"
    found.chat_template = (templates / "qwen3.jinja").read_text()
    return found


class ScriptedTrainer(trl.GRPOTrainer):
    """Its model learns, but its turns are given: random weights would never call a tool."""

    def __init__(self, *args: Any, script: Script, **more: Any) -> None:
        super().__init__(*args, **more)
        self.script = script

    def _generate_and_score_completions(self, inputs: Any) -> Any:
        self.turns = [deque(calls) for calls in self.script]
        self.calling = list(range(len(self.script)))
        return super()._generate_and_score_completions(inputs)

    def _generate_single_turn(self, prompt_ids: Any, *_: Any, **__: Any) -> Any:
        assert len(self.calling) == len(prompt_ids)
        playing, self.calling = self.calling, [one for one in self.calling if self.turns[one]]
        return [self._turn(index) for index in playing], None

    def _turn(self, index: int) -> list[int]:
        if not self.turns[index]:
            return self.processing_class.encode("done<|im_end|>")
        name, arguments = self.turns[index].popleft()
        call = json.dumps({"name": name, "arguments": arguments})
        return self.processing_class.encode(f"<tool_call>\n{call}\n</tool_call><|im_end|>")


def tiny_model() -> tuple[Any, Any]:
    """A model and its tokenizer."""
    words = tokenizer()
    config = LlamaConfig(
        vocab_size=len(words),
        hidden_size=16,
        intermediate_size=16,
        num_hidden_layers=1,
        num_attention_heads=2,
        max_position_embeddings=4096,
        pad_token_id=words.pad_token_id,
        eos_token_id=words.eos_token_id,
        bos_token_id=None,
    )
    return LlamaForCausalLM(config), words


def trainer_args(folder: Path, batch: int, steps: int) -> Any:
    """Arguments of a trainer on the CPU; `batch` is a multiple of four."""
    return trl.GRPOConfig(
        output_dir=str(folder),
        per_device_train_batch_size=batch,
        max_steps=steps,
        num_generations=4,
        max_completion_length=2048,
        use_cpu=True,
        report_to=[],
        save_strategy="no",
        logging_steps=1,
        learning_rate=0.1,
        disable_tqdm=True,
        shuffle_dataset=False,
    )


def trainer_of(rows: Any, script: Script, folder: Path, steps: int, **more: Any) -> Any:
    """A trainer whose batch is as large as the script."""
    model, words = tiny_model()
    args = trainer_args(folder, len(script), steps)
    return ScriptedTrainer(
        model, args=args, processing_class=words, train_dataset=rows, script=script, **more
    )
