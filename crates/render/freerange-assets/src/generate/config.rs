//! Which objects are generated, and how often each kind.

use serde::{Deserialize, Serialize};

use freerange_util::{Invalid, check};

/// Families of generated objects.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// Overlapping primitives with unrelated textures.
    Composition,
    /// Cup, mug or tumbler.
    Mug,
    /// Bowl, dish, ramekin.
    Bowl,
    /// Can with a label band.
    Can,
    /// Bottle or jar with a cap, round or square.
    Bottle,
    /// Carton with printed faces: boxes and gable tops.
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
    /// Plate or saucer, plain, ringed or painted.
    Plate,
    /// Jar, vase or candle glass.
    Jar,
    /// Teapot, kettle or jug with spout and handle.
    Teapot,
    /// Lamp or candlestick.
    Lamp,
    /// Box with open lid or flaps.
    OpenBox,
    /// Book or stack of books.
    Book,
    /// Bag, stand-up pouch, sachet, cushion.
    Pouch,
    /// Squeezed tube with a cap.
    Tube,
    /// Animal, figure, car or shoe of smoothly joined pieces.
    Toy,
    /// Roll, folded towels, hat.
    Textile,
    /// Basket woven in relief.
    Wicker,
    /// Basket of wires.
    Wire,
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
    /// Weight of [`Kind::Plate`].
    pub plate: f32,
    /// Weight of [`Kind::Jar`].
    pub jar: f32,
    /// Weight of [`Kind::Teapot`].
    pub teapot: f32,
    /// Weight of [`Kind::Lamp`].
    pub lamp: f32,
    /// Weight of [`Kind::OpenBox`].
    pub open_box: f32,
    /// Weight of [`Kind::Book`].
    pub book: f32,
    /// Weight of [`Kind::Pouch`].
    pub pouch: f32,
    /// Weight of [`Kind::Tube`].
    pub tube: f32,
    /// Weight of [`Kind::Toy`].
    pub toy: f32,
    /// Weight of [`Kind::Textile`].
    pub textile: f32,
    /// Weight of [`Kind::Wicker`].
    pub wicker: f32,
    /// Weight of [`Kind::Wire`].
    pub wire: f32,
    /// Share of objects that stand upright (turned about z only).
    pub upright_share: f32,
    /// Share of objects that lie on a side; the rest is turned arbitrarily.
    pub lying_share: f32,
    /// Share of materials that start from white, cream or porcelain.
    pub white_share: f32,
    /// Share of materials with a patterned texture instead of a plain color.
    pub pattern_share: f32,
    /// Share of materials with a glossy clear layer.
    pub gloss_share: f32,
    /// Labels, writing and painted decoration. Without, each is its mean color on otherwise the same object.
    pub prints: bool,
}

impl Default for GeneratorConfig {
    fn default() -> Self {
        Self {
            composition: 3.2,
            mug: 2.0,
            bowl: 2.0,
            can: 1.5,
            bottle: 1.8,
            carton: 2.4,
            pan: 1.1,
            fruit: 1.3,
            loaf: 0.7,
            basket: 0.6,
            rack: 0.4,
            utensil: 0.9,
            stack: 0.9,
            plate: 0.8,
            jar: 1.1,
            teapot: 0.8,
            lamp: 0.4,
            open_box: 0.5,
            book: 0.6,
            pouch: 0.8,
            tube: 0.5,
            toy: 0.9,
            textile: 0.5,
            wicker: 0.7,
            wire: 0.5,
            upright_share: 0.6,
            lying_share: 0.2,
            white_share: 0.27,
            pattern_share: 0.55,
            gloss_share: 0.4,
            prints: true,
        }
    }
}

impl GeneratorConfig {
    /// Each family with its weight.
    pub fn weights(&self) -> [(Kind, f32); 25] {
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
            (Kind::Plate, self.plate),
            (Kind::Jar, self.jar),
            (Kind::Teapot, self.teapot),
            (Kind::Lamp, self.lamp),
            (Kind::OpenBox, self.open_box),
            (Kind::Book, self.book),
            (Kind::Pouch, self.pouch),
            (Kind::Tube, self.tube),
            (Kind::Toy, self.toy),
            (Kind::Textile, self.textile),
            (Kind::Wicker, self.wicker),
            (Kind::Wire, self.wire),
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
            plate: weight(Kind::Plate),
            jar: weight(Kind::Jar),
            teapot: weight(Kind::Teapot),
            lamp: weight(Kind::Lamp),
            open_box: weight(Kind::OpenBox),
            book: weight(Kind::Book),
            pouch: weight(Kind::Pouch),
            tube: weight(Kind::Tube),
            toy: weight(Kind::Toy),
            textile: weight(Kind::Textile),
            wicker: weight(Kind::Wicker),
            wire: weight(Kind::Wire),
            ..Self::default()
        }
    }

    /// Checks that weights are finite, not negative and not all zero, and that shares lie in [0, 1].
    pub fn validate(&self) -> Result<(), Invalid> {
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
