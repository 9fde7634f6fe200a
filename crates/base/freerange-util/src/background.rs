//! The color behind an object.

use rand::Rng;

/// What lies behind an object, and behind transparent pixels of its views, where renders are compared with views.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Background {
    /// Another uniformly drawn color every time: nothing can hide against all of them, so that the opacity has to agree
    /// with the views' alpha.
    #[default]
    Random,
    /// White, as in the evaluation.
    White,
    /// Black.
    Black,
}

impl Background {
    /// The color, drawn from `rng` if need be; linear or encoded is the caller's choice.
    pub fn draw(self, rng: &mut impl Rng) -> [f32; 3] {
        match self {
            Self::Random => rng.random(),
            Self::White => [1.0; 3],
            Self::Black => [0.0; 3],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn only_the_random_one_draws() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        assert_eq!(Background::White.draw(&mut rng), [1.0; 3]);
        assert_eq!(Background::Black.draw(&mut rng), [0.0; 3]);
        let drawn = Background::Random.draw(&mut rng);
        assert_eq!(drawn, ChaCha8Rng::seed_from_u64(1).random::<[f32; 3]>());
        assert_ne!(drawn, Background::Random.draw(&mut rng));
    }
}
