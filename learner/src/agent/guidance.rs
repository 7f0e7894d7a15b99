//! How far a Q-gradient is to be trusted: Eq. 21–24.

/// What the critics' gradients say about each action of a batch.
#[derive(Clone, Debug, Default)]
pub struct Uncertainty {
    /// Unit direction u of the predicted noise, `B × a` (Eq. 21).
    pub direction: Vec<f32>,
    /// Ensemble-mean gradient ḡ, `B × a` (Eq. 10).
    pub gradient: Vec<f32>,
    /// Variance σ² of u·g_k over the critics, B (Eq. 22).
    pub variance: Vec<f32>,
    /// Variance of the ensemble mean of u·g_k over the batch (Eq. 23).
    pub batch_variance: f32,
}

impl Uncertainty {
    /// From g_k, `K × B × a`, and the predicted noise, `B × a`.
    pub fn measure(&mut self, gradients: &[f32], noise: &[f32], action_dim: usize) {
        let critics = (gradients.len() / noise.len()) as f32;
        self.direction.clear();
        for noise in noise.chunks_exact(action_dim) {
            let norm = noise.iter().map(|x| x * x).sum::<f32>().sqrt() + 1e-8;
            self.direction.extend(noise.iter().map(|x| x / norm));
        }
        self.gradient.clear();
        self.gradient.resize(noise.len(), 0.0);
        for g in gradients.chunks_exact(noise.len()) {
            self.gradient.iter_mut().zip(g).for_each(|(mean, g)| *mean += g / critics);
        }
        // l_k = u·g_k for one action.
        let alignment = |g: &[f32], i: usize| {
            let at = i * action_dim..(i + 1) * action_dim;
            g[at.clone()].iter().zip(&self.direction[at]).map(|(g, u)| g * u).sum::<f32>()
        };
        let means: Vec<f32> = (0..noise.len() / action_dim).map(|i| alignment(&self.gradient, i)).collect();
        self.variance.clear();
        self.variance.extend(means.iter().enumerate().map(|(i, mean)| {
            let square = |g: &[f32]| (alignment(g, i) - mean).powi(2);
            gradients.chunks_exact(noise.len()).map(square).sum::<f32>() / critics
        }));
        self.batch_variance = variance(&means);
    }
}

/// λ = ν̂²/(ν̂² + σ²/τ + δ), Eq. 24.
pub(super) fn weight(nu_squared: f32, variance: f32, tau: f32, delta: f32) -> f32 {
    nu_squared / (nu_squared + variance / tau + delta)
}

/// Population variance.
fn variance(x: &[f32]) -> f32 {
    let mean = x.iter().sum::<f32>() / x.len() as f32;
    x.iter().map(|x| (x - mean).powi(2)).sum::<f32>() / x.len() as f32
}
