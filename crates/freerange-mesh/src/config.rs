use serde::{Deserialize, Serialize};

use crate::error::{MeshError, check};

/// Families of generated objects.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// Overlapping primitives with unrelated textures.
    Composition,
    /// Cup or mug with a handle.
    Mug,
    /// Bowl, plate, dish, ramekin.
    Bowl,
    /// Can with a label band.
    Can,
    /// Bottle or jar with a cap, round or square.
    Bottle,
    /// Carton with printed faces.
    Carton,
    /// Frying pan or pot with handles.
    Pan,
    /// Fruit and vegetables.
    Fruit,
    /// Bread, cake, cheese: a deformed block.
    Loaf,
    /// Open box, basket, tray, colander: pierced or partitioned thin walls.
    Basket,
    /// Racks and stands made of bars.
    Rack,
    /// Knife, spoon, brush, tool: long objects made of two or three pieces.
    Utensil,
    /// Toys, furniture, lamps: pieces stacked along z with shared materials.
    Stack,
}

/// What is generated and how often. Weights are relative; zero leaves a family out.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GeneratorConfig {
    /// Weight of [`Kind::Composition`].
    pub composition: f32,
    /// Weight of [`Kind::Mug`].
    pub mug: f32,
    /// Weight of [`Kind::Bowl`].
    pub bowl: f32,
    /// Weight of [`Kind::Can`].
    pub can: f32,
    /// Weight of [`Kind::Bottle`].
    pub bottle: f32,
    /// Weight of [`Kind::Carton`].
    pub carton: f32,
    /// Weight of [`Kind::Pan`].
    pub pan: f32,
    /// Weight of [`Kind::Fruit`].
    pub fruit: f32,
    /// Weight of [`Kind::Loaf`].
    pub loaf: f32,
    /// Weight of [`Kind::Basket`].
    pub basket: f32,
    /// Weight of [`Kind::Rack`].
    pub rack: f32,
    /// Weight of [`Kind::Utensil`].
    pub utensil: f32,
    /// Weight of [`Kind::Stack`].
    pub stack: f32,
    /// Share of objects that stand upright (turned about z only).
    pub upright_share: f32,
    /// Share of objects that lie on a side; the rest is turned arbitrarily.
    pub lying_share: f32,
    /// Share of materials that start from white, cream or porcelain.
    pub white_share: f32,
    /// Share of materials with a patterned texture instead of a plain colour.
    pub pattern_share: f32,
    /// Share of materials with a polished clear layer.
    pub gloss_share: f32,
}

impl Default for GeneratorConfig {
    fn default() -> Self {
        Self {
            composition: 5.0,
            mug: 1.6,
            bowl: 1.6,
            can: 0.9,
            bottle: 1.4,
            carton: 1.8,
            pan: 0.8,
            fruit: 1.1,
            loaf: 0.6,
            basket: 1.0,
            rack: 0.5,
            utensil: 0.8,
            stack: 1.4,
            upright_share: 0.6,
            lying_share: 0.2,
            white_share: 0.27,
            pattern_share: 0.55,
            gloss_share: 0.4,
        }
    }
}

impl GeneratorConfig {
    /// Each family with its weight.
    pub fn weights(&self) -> [(Kind, f32); 13] {
        [
            (Kind::Composition, self.composition),
            (Kind::Mug, self.mug),
            (Kind::Bowl, self.bowl),
            (Kind::Can, self.can),
            (Kind::Bottle, self.bottle),
            (Kind::Carton, self.carton),
            (Kind::Pan, self.pan),
            (Kind::Fruit, self.fruit),
            (Kind::Loaf, self.loaf),
            (Kind::Basket, self.basket),
            (Kind::Rack, self.rack),
            (Kind::Utensil, self.utensil),
            (Kind::Stack, self.stack),
        ]
    }

    /// A configuration that generates one family only.
    pub fn only(kind: Kind) -> Self {
        let weight = |k: Kind| if k == kind { 1.0 } else { 0.0 };
        Self {
            composition: weight(Kind::Composition),
            mug: weight(Kind::Mug),
            bowl: weight(Kind::Bowl),
            can: weight(Kind::Can),
            bottle: weight(Kind::Bottle),
            carton: weight(Kind::Carton),
            pan: weight(Kind::Pan),
            fruit: weight(Kind::Fruit),
            loaf: weight(Kind::Loaf),
            basket: weight(Kind::Basket),
            rack: weight(Kind::Rack),
            utensil: weight(Kind::Utensil),
            stack: weight(Kind::Stack),
            ..Self::default()
        }
    }

    /// Checks that weights are finite, not negative and not all zero, and that shares lie in [0, 1].
    pub fn validate(&self) -> Result<(), MeshError> {
        let weights = self.weights();
        for (_, w) in weights {
            check((0.0..=1e6).contains(&w), "weights", "0 to 1e6", w)?;
        }
        check(weights.iter().any(|&(_, w)| w > 0.0), "weights", "at least one above 0", "none")?;
        for (field, share) in [
            ("upright_share", self.upright_share),
            ("lying_share", self.lying_share),
            ("white_share", self.white_share),
            ("pattern_share", self.pattern_share),
            ("gloss_share", self.gloss_share),
        ] {
            check((0.0..=1.0).contains(&share), field, "0 to 1", share)?;
        }
        check(
            self.upright_share + self.lying_share <= 1.0,
            "upright_share + lying_share",
            "at most 1",
            self.upright_share + self.lying_share,
        )
    }
}
