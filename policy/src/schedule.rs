//! The variance-preserving noise schedule and one step of the reverse process.

/// Constants of the diffusion over t = 1..T (Eq. 3–5; DAC's "vp" schedule).
#[derive(Clone, Debug, PartialEq)]
pub struct Schedule {
    /// β_t, `beta[t - 1]`.
    pub beta: Vec<f32>,
    /// ᾱ_t, `alpha_bar[t - 1]`; ᾱ_0 = 1.
    pub alpha_bar: Vec<f32>,
    steps: Vec<Reverse>,
}

/// Coefficients of one reverse step.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Reverse {
    /// 1/sqrt(ᾱ_t).
    clean_scale: f32,
    /// sqrt(1 - ᾱ_t).
    noise_scale: f32,
    /// Of the clipped x_0 in the posterior's mean.
    from_clean: f32,
    /// Of x_t in the posterior's mean.
    from_noisy: f32,
    /// sqrt(1 - α_t), or 0 at t = 1.
    deviation: f32,
}

impl Schedule {
    /// β_t = 1 - exp(-0.1/T - 0.5·(10 - 0.1)·(2t - 1)/T²) for t = 1..T.
    pub fn variance_preserving(steps: usize) -> Self {
        let total = steps as f64;
        let mut before = 1.0; // ᾱ_{t-1}
        let mut schedule = Self { beta: Vec::new(), alpha_bar: Vec::new(), steps: Vec::new() };
        for t in 1..=steps {
            let alpha = (-0.1 / total - 0.5 * (10.0 - 0.1) * (2 * t - 1) as f64 / (total * total)).exp();
            let alpha_bar = before * alpha;
            schedule.beta.push((1.0 - alpha) as f32);
            schedule.alpha_bar.push(alpha_bar as f32);
            schedule.steps.push(Reverse {
                clean_scale: (1.0 / alpha_bar.sqrt()) as f32,
                noise_scale: (1.0 - alpha_bar).sqrt() as f32,
                from_clean: (before.sqrt() * (1.0 - alpha) / (1.0 - alpha_bar)) as f32,
                from_noisy: (alpha.sqrt() * (1.0 - before) / (1.0 - alpha_bar)) as f32,
                deviation: if t == 1 { 0.0 } else { (1.0 - alpha).sqrt() as f32 },
            });
            before = alpha_bar;
        }
        schedule
    }

    /// T.
    pub fn steps(&self) -> usize {
        self.steps.len()
    }

    /// (sqrt(ᾱ_t), sqrt(1 - ᾱ_t)) of Eq. 5; the second is also the guidance weight w(t).
    pub fn noising(&self, t: usize) -> (f32, f32) {
        (self.alpha_bar[t - 1].sqrt(), self.steps[t - 1].noise_scale)
    }

    /// x_t → x_{t-1} in place: the posterior's mean with x_0 clipped to [-1, 1], plus its noise for t > 1.
    ///
    /// `epsilon` is the predicted noise; `z`, standard normal, is not read at t = 1.
    pub fn reverse(&self, t: usize, x: &mut [f32], epsilon: &[f32], z: &[f32]) {
        let step = self.steps[t - 1];
        for (i, (x, epsilon)) in x.iter_mut().zip(epsilon).enumerate() {
            let clean = ((*x - step.noise_scale * epsilon) * step.clean_scale).clamp(-1.0, 1.0);
            *x = step.from_clean * clean + step.from_noisy * *x;
            if t > 1 {
                *x += step.deviation * z[i];
            }
        }
    }
}
