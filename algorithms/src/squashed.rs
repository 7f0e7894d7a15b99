//! A tanh-squashed Gaussian policy in training (Haarnoja et al. 2018, "Soft Actor-Critic", appendix
//! C): a = tanh(u), where a network of the state gives mean and log σ of u. Actions are drawn with
//! a gradient, and their densities have the tanh's Jacobian.

use candle_core::{Result, Tensor};
use quad_nn::{AdamStep, Ensemble, Gradients, MlpConfig, Tensors, Weights};
use quad_policy::{PolicyConfig, Spread};

use super::gaussian::gaussian_policy;
use super::networks::{Initializer, TrainState};
use super::state_dict::{StateDict, Stateful};

pub(super) struct Squashed {
    /// Mean and x of each state, `[n, 2a]`.
    pub network: TrainState<Ensemble>,
    /// c₁ and c₂ where log σ is c₁·x + c₂; else it is x.
    map: Option<TrainState<Weights>>,
    /// Bounds of log σ.
    bounds: (f32, f32),
}

impl Squashed {
    /// A policy whose log σ is the network's output.
    pub fn new(layers: &MlpConfig, bounds: (f32, f32), init: &mut Initializer<'_>) -> Result<Self> {
        let network = init.state_network(layers, 2 * init.context.action_dim())?;
        Ok(Self { network, map: None, bounds })
    }

    /// Makes log σ a learned linear function of the network's output with these initial c₁ and c₂,
    /// and the last layer smaller by a factor.
    pub fn with_map(mut self, map: [f32; 2], factor: f64, init: &Initializer<'_>) -> Result<Self> {
        self.map = Some(init.numbers("log_std_map", &map)?);
        self.network = self.network.scale_last_layer(factor)?;
        Ok(self)
    }

    /// The distributions of u in these states, `[n, o]`; differentiable in all that is learned.
    pub fn distribution(&self, observations: &Tensor) -> Result<Normal> {
        self.forward(&self.network, observations)
    }

    /// [`Self::distribution`] as constants.
    pub fn constant_distribution(&self, observations: &Tensor) -> Result<Normal> {
        let distribution = self.forward(&self.network.detach(), observations)?;
        Ok(distribution.detach())
    }

    fn forward(&self, network: &Ensemble, observations: &Tensor) -> Result<Normal> {
        let out = network.state_outputs(observations)?.squeeze(0)?;
        let a = out.dim(1)? / 2;
        let (mean, x) = (out.narrow(1, 0, a)?, out.narrow(1, a, a)?);
        let log_std = match &self.map {
            Some(map) => {
                let c = map.values();
                x.broadcast_mul(&c.narrow(0, 0, 1)?)?.broadcast_add(&c.narrow(0, 1, 1)?)?
            }
            None => x,
        };
        let log_std = log_std.clamp(self.bounds.0, self.bounds.1)?;
        Ok(Normal { mean, log_std })
    }

    /// Moves all that is learned down a loss `[]`.
    pub fn minimize(&mut self, loss: &Tensor, step: AdamStep) -> Result<()> {
        let gradients = Gradients::backward(loss)?;
        self.network.apply_gradients(&gradients, step)?;
        if let Some(map) = &mut self.map {
            map.apply_gradients(&gradients, step)?;
        }
        Ok(())
    }

    /// The policy that acts by tanh(mean) and explores by draws. c₁ and c₂ become part of the last
    /// layer.
    pub fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        let (policy, mut tensors) = gaussian_policy(&self.network, Spread::Squashed, None)?;
        let Some(map) = &self.map else {
            return Ok((policy, tensors));
        };
        let c: Vec<f32> = map.values().detach().to_vec1()?;
        let shape = self.network.shape();
        let (a, last) = (shape.outputs / 2, format!(".{}.", shape.layers.hidden.len()));
        for (name, tensor) in tensors.iter_mut().filter(|(name, _)| name.contains(&last)) {
            let columns = tensor.rank() - 1;
            let offset = if name.ends_with("bias") { c[1] } else { 0.0 };
            let (mean, x) = (tensor.narrow(columns, 0, a)?, tensor.narrow(columns, a, a)?);
            let x = x.affine(c[0].into(), offset.into())?;
            *tensor = Tensor::cat(&[mean, x], columns)?;
        }
        Ok((policy, tensors))
    }
}

impl Stateful for Squashed {
    fn add_to<'a>(&'a mut self, dict: &mut StateDict<'a>, name: &str) {
        self.network.add_to(dict, name);
        self.map.add_to(dict, name);
    }
}

/// Normal distributions of u, one for each of n states.
pub(super) struct Normal {
    /// `[n, a]`.
    pub mean: Tensor,
    /// log σ, `[n, a]`.
    pub log_std: Tensor,
}

/// Actions that were drawn, S for each state.
pub(super) struct Drawn {
    /// tanh(u), `[n, S, a]`.
    pub actions: Tensor,
    /// log π(a|s), `[n, S]`.
    pub log_density: Tensor,
}

impl Normal {
    pub fn detach(&self) -> Self {
        let [mean, log_std] = [&self.mean, &self.log_std].map(Tensor::detach);
        Self { mean, log_std }
    }

    /// Actions tanh(mean + σ·noise) for standard normal noise `[n, S, a]`. Actions and densities
    /// are differentiable in mean and log σ.
    pub fn draw(&self, noise: &Tensor) -> Result<Drawn> {
        let (mean, log_std) = (self.mean.unsqueeze(1)?, self.log_std.unsqueeze(1)?);
        let u = noise.broadcast_mul(&log_std.exp()?)?.broadcast_add(&mean)?;
        Ok(Drawn { actions: u.tanh()?, log_density: log_density(&u, noise, &log_std)? })
    }

    /// log π(a|s), `[n]`, of actions within (−1, 1), `[n, a]`.
    pub fn log_density(&self, actions: &Tensor) -> Result<Tensor> {
        let u = (((1.0 + actions)?.log()? - (1.0 - actions)?.log()?)? * 0.5)?;
        let noise = ((&u - &self.mean)? / self.log_std.exp()?)?;
        log_density(&u, &noise, &self.log_std)
    }
}

/// log π(tanh u), summed over the last dimension, for noise (u − mean)/σ: log N(u) − log(1 − tanh²
/// u). The second is taken as 2·(log 2 − |u| − log(1 + e^(−2|u|))), which is exact also where tanh
/// u rounds to ±1.
fn log_density(u: &Tensor, noise: &Tensor, log_std: &Tensor) -> Result<Tensor> {
    let size = u.abs()?;
    let softplus = (size.affine(-2.0, 0.0)?.exp()? + 1.0)?.log()?;
    let jacobian = (softplus + size)?.affine(-2.0, 2.0 * 2f64.ln())?;
    let half_log_2_pi = 0.5 * (2.0 * std::f64::consts::PI).ln();
    let normal = noise.sqr()?.affine(-0.5, -half_log_2_pi)?;
    let normal = normal.broadcast_sub(log_std)?;
    (normal - jacobian)?.sum(candle_core::D::Minus1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::Device;

    /// The density is still that of u: log(1 − tanh² u) is 2·(log 2 − u) where tanh(u) is 1 in f32.
    #[test]
    fn densities_are_finite_where_actions_round_to_one() {
        let number = |x: f32| Tensor::new(&[[x]], &Device::Cpu).unwrap();
        let (mean, log_std) = (number(30.0), number(0.0));
        let noise = number(0.0).unsqueeze(1).unwrap();
        let drawn = Normal { mean, log_std }.draw(&noise).unwrap();
        let [action, log_density] = [drawn.actions, drawn.log_density]
            .map(|x| x.flatten_all().unwrap().to_vec1::<f32>().unwrap()[0]);
        let expected = -0.5 * (2.0 * std::f32::consts::PI).ln() - 2.0 * (2f32.ln() - 30.0);
        assert_eq!(action, 1.0);
        assert!((log_density - expected).abs() < 1e-4, "{log_density}");
    }
}
