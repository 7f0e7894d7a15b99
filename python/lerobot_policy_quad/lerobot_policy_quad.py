"""LeRobot's plugin for the folders of `quad_rl.export_lerobot`. LeRobot looks for QuadPolicy in the module of QuadConfig."""

import importlib
from dataclasses import dataclass, field

import numpy as np
import quad_rl
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from quad_rl._lerobot import act, inputs, places
from quad_rl.readers.lerobot import flat_names
from quad_rl.readers.video import column


def _untrainable(*_, **__):
    raise NotImplementedError("LeRobot cannot train policies of QUAD\nhint: quad_rl.train, then quad_rl.export_lerobot")


@PreTrainedConfig.register_subclass("quad")
@dataclass
class QuadConfig(PreTrainedConfig):
    """encoders: the functions by which a policy sees images, such as {"observation.images.top": "my_module:my_function"}."""

    encoders: dict[str, str] = field(default_factory=dict)

    observation_delta_indices = action_delta_indices = reward_delta_indices = None
    get_optimizer_preset = get_scheduler_preset = _untrainable

    def validate_features(self) -> None:
        """The weights know which features they need: see QuadPolicy."""


class QuadPolicy(PreTrainedPolicy):
    """Acts a step or a chunk at a time. Each row of a batch is an episode; torch's global generator gives its seed."""

    config_class, name = QuadConfig, "quad"
    forward = get_optim_params = _untrainable

    def __init__(self, config: QuadConfig, dataset_meta=None, **_):
        super().__init__(config)
        self._dataset = dataset_meta.features if dataset_meta is not None else {}

    @classmethod
    def _load_as_safetensor(cls, model, model_file, map_location, strict):
        model.policy = policy = quad_rl.Policy.load(model_file)
        features = inputs(policy, model._dataset)
        wanted = policy.observation_names or [*map(str, range(policy.observation_size))]
        done = policy.action_names or [*map(str, range(policy.action_size))]
        model._seen = {name: model._called(name, [wanted[i] for i in columns]) for name, columns in features.items()}
        model._encoders = {name: model._encoder(name, names[0]) for name, names in model._seen.items() if "image" in name}
        model._observations = places(wanted, sum(model._seen.values(), []))
        called = model._called("action", done)
        model._actions, _ = places(called, done), places(done, called)
        model.reset()
        return model

    def _save_pretrained(self, save_directory, **_) -> None:
        quad_rl.export_lerobot(self.policy, save_directory)
        self.config._save_pretrained(save_directory)

    def _called(self, feature: str, names: list[str]) -> list[str]:
        """The names of a feature's numbers: the dataset's, or the policy's if only one of them has names."""
        there = flat_names(self._dataset.get(feature, {}).get("names"))
        if not there or "image" in feature or names[0] in ("0", feature, f"{feature}[0]"):
            return names
        prefix = f"{feature}." if names[0].startswith(f"{feature}.") else ""
        return [prefix + name for name in there]

    def _encoder(self, feature: str, name: str):
        module, _, function = self.config.encoders.get(feature, "").partition(":")
        encoder = getattr(importlib.import_module(module), function) if function else None
        if encoder and name.startswith(f"{column(feature, encoder)}["):
            return encoder
        hint = f"hint: --policy.encoders='{{\"{feature}\": \"MODULE:FUNCTION\"}}'"
        raise ValueError(f"the policy sees {name}, by a function that is not given\n{hint}")

    def reset(self) -> None:
        self._episodes = None

    def _rows(self, batch: dict[str, torch.Tensor]) -> np.ndarray:
        parts = []
        for feature, names in self._seen.items():
            if feature not in batch:
                raise ValueError(f"there is no {feature}\nhint: there are {', '.join(batch)}; --rename_map renames")
            numbers = batch[feature].cpu()
            if feature in self._encoders:  # From [n, 3, h, w] within [0, 1].
                numbers = self._encoders[feature]((numbers * 255).round().to(torch.uint8).permute(0, 2, 3, 1).numpy())
            parts.append(np.asarray(numbers, np.float32).reshape(len(numbers), -1))
            if parts[-1].shape[1] != len(names):
                raise ValueError(f"{feature} has {parts[-1].shape[1]} numbers, not {len(names)}: {', '.join(names)}")
        return np.concatenate(parts, axis=1)

    def _begin(self, count: int) -> quad_rl.Episodes:
        seed = int(torch.randint(2**31, ()))
        return self.policy.begin([*range(seed, seed + count)])

    @torch.no_grad()
    def select_action(self, batch: dict[str, torch.Tensor], **_) -> torch.Tensor:
        rows = self._rows(batch)
        if self._episodes is None or len(self._episodes) != len(rows):
            self._episodes = self._begin(len(rows))
        return torch.from_numpy(act(self._episodes, rows, self._observations, self._actions))

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, torch.Tensor], **_) -> torch.Tensor:
        """The actions of a new chunk that are executed, [n, replan, action_size], whatever `select_action` has left of its own."""
        chunk, rows = self.policy.about["chunk"], self._rows(batch)
        if chunk["history"] > 1:
            raise ValueError("the policy sees several observations, and a batch has one\nhint: train it with --agent history=1")
        episodes = self._begin(len(rows))  # The first call draws the chunk that the others execute.
        actions = [act(episodes, rows, self._observations, self._actions) for _ in range(chunk["replan"])]
        return torch.from_numpy(np.stack(actions, axis=1))
