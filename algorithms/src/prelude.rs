//! The names that the file of an algorithm needs.

pub(super) use super::algorithm::Algorithm;
pub(super) use super::batch::Batch;
pub(super) use super::context::Context;
pub(super) use super::definition::{
    Definition, Metric, Start, Variant, metrics, read, read_with, start,
};
pub(super) use super::error::{AgentError, AlgorithmError, check};
pub(super) use super::examples::Columns;
pub(super) use super::hyperparameters::{
    Candidates, Count, Finite, NotNegative, OpenUnit, Positive, Rate, Steps, UnitInterval,
    first_steps, phase,
};
pub(super) use super::losses::{Loss, Measured, largest, lower_bound, measured, reduced, smallest};
pub(super) use super::networks::{
    Initializer, TWIN, TrainState, WithTarget, networks, state_value,
};
pub(super) use super::state_dict::StateDict;
pub(super) use candle_core::{DType, Device, Result, Tensor};
pub(super) use quad_nn::{
    AdamStep, Ensemble, EnsembleShape, Gradients, MlpConfig, Tensors, Weighted, cosine_decay,
    squared_error,
};
pub(super) use quad_policy::{Aggregate, Choice, PolicyConfig, Rule};
pub(super) use serde::Deserialize;
