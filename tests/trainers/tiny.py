"""A tiny language model with random weights, and arguments of TRL's trainer for it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
import trl
from tokenizers import Tokenizer, decoders, models, pre_tokenizers
from transformers import LlamaConfig, LlamaForCausalLM, PreTrainedTokenizerFast

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["tiny_model", "tokenizer", "trainer_args"]


def tokenizer() -> PreTrainedTokenizerFast:
    """A token for each byte."""
    special = ["<|pad|>", "<|end|>"]
    letters = sorted(pre_tokenizers.ByteLevel.alphabet())
    words = {word: number for number, word in enumerate(special + letters)}
    made = Tokenizer(models.BPE(vocab=words, merges=[]))
    made.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    made.decoder = decoders.ByteLevel()
    made.add_special_tokens(special)
    return PreTrainedTokenizerFast(tokenizer_object=made, eos_token="<|end|>", pad_token="<|pad|>")


def tiny_model(words: Any) -> Any:
    """Of the same weights each time."""
    torch.manual_seed(0)
    config = LlamaConfig(
        vocab_size=len(words),
        hidden_size=16,
        intermediate_size=16,
        num_hidden_layers=1,
        num_attention_heads=2,
        max_position_embeddings=128,
        pad_token_id=words.pad_token_id,
        eos_token_id=words.eos_token_id,
        bos_token_id=None,
    )
    return LlamaForCausalLM(config)


def trainer_args(folder: Path, **more: Any) -> Any:
    """Two steps on the CPU, each of two prompts with four rollouts."""
    return trl.GRPOConfig(
        output_dir=str(folder),
        per_device_train_batch_size=8,
        max_steps=2,
        num_generations=4,
        max_completion_length=6,
        use_cpu=True,
        bf16=False,
        report_to=[],
        save_strategy="no",
        logging_steps=1,
        learning_rate=0.1,
        disable_tqdm=True,
        shuffle_dataset=False,
        **more,
    )
