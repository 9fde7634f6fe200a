//! JSON of clients, looked at as it is read: nothing of it is held.

use std::{cell::RefCell, fmt, io::Read};

use serde::de::{DeserializeSeed, Deserializer, Error, MapAccess, SeqAccess, Visitor};

/// Most values of a file. Each takes some 72 bytes in a reader; a thousand photos have thirty thousand.
const VALUES: usize = 300_000;

/// Why a file is not taken.
#[derive(Debug, PartialEq, Eq)]
pub enum Odd {
    /// It has more values than this.
    Many(usize),
    /// It names this file, which lies elsewhere.
    Outside(String),
}

/// Looks at a file. What is not JSON is for its reader to refuse, with line and column.
pub fn look(file: impl Read) -> Result<(), Odd> {
    let found = RefCell::new((0, None));
    let walk = Walk { found: &found, names_file: false };
    // Nesting is bounded by the parser.
    let _ = walk.deserialize(&mut serde_json::Deserializer::from_reader(file));
    match found.into_inner().1 {
        Some(odd) => Err(odd),
        None => Ok(()),
    }
}

/// What looks at one value.
#[derive(Clone, Copy)]
struct Walk<'f> {
    found: &'f RefCell<(usize, Option<Odd>)>,
    /// Whether the value's key says that it is the name of a file.
    names_file: bool,
}

impl Walk<'_> {
    fn count<E: Error>(self) -> Result<(), E> {
        let mut found = self.found.borrow_mut();
        found.0 += 1;
        if found.0 <= VALUES {
            return Ok(());
        }
        found.1 = Some(Odd::Many(VALUES));
        Err(E::custom("many"))
    }
}

impl<'de> DeserializeSeed<'de> for Walk<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, from: D) -> Result<(), D::Error> {
        from.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Walk<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("JSON")
    }

    fn visit_bool<E: Error>(self, _: bool) -> Result<(), E> {
        self.count()
    }

    fn visit_i64<E: Error>(self, _: i64) -> Result<(), E> {
        self.count()
    }

    fn visit_u64<E: Error>(self, _: u64) -> Result<(), E> {
        self.count()
    }

    fn visit_f64<E: Error>(self, _: f64) -> Result<(), E> {
        self.count()
    }

    fn visit_unit<E: Error>(self) -> Result<(), E> {
        self.count()
    }

    fn visit_str<E: Error>(self, text: &str) -> Result<(), E> {
        self.count()?;
        if self.names_file && leaves(text) {
            self.found.borrow_mut().1 = Some(Odd::Outside(text.to_owned()));
            return Err(E::custom("outside"));
        }
        Ok(())
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<(), A::Error> {
        self.count()?;
        while items.next_element_seed(Walk { names_file: false, ..self })?.is_some() {}
        Ok(())
    }

    fn visit_map<A: MapAccess<'de>>(self, mut fields: A) -> Result<(), A::Error> {
        self.count()?;
        while let Some(key) = fields.next_key::<String>()? {
            let names_file = key.ends_with("path") || key.ends_with("file") || key == "image" || key == "mask";
            fields.next_value_seed(Walk { names_file, ..self })?;
        }
        Ok(())
    }
}

/// Whether a path leaves its folder.
fn leaves(text: &str) -> bool {
    let absolute = text.starts_with(['/', '\\', '~']) || text.chars().nth(1) == Some(':');
    let up = text.split(['/', '\\']).any(|part| part == "..");
    absolute || up || text.contains('\0')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cameras_name_no_files_elsewhere() {
        let of = |text: &str| look(text.as_bytes());
        assert_eq!(of(r#"{"frames": [{"file_path": "./train/000"}], "note": "../x"}"#), Ok(()));
        for odd in ["/etc/passwd", "../x", "a/../../x", "C:\\\\x", "~/x", "\\\\\\\\host\\\\x"] {
            let found = of(&format!(r#"{{"frames": [{{"mask_path": "{odd}"}}]}}"#));
            assert!(matches!(found, Err(Odd::Outside(_))), "{odd}: {found:?}");
        }
    }

    #[test]
    fn values_are_counted_and_nesting_ends() {
        let of = |text: String| look(text.as_bytes());
        assert_eq!(of(format!("[{}0]", "0,".repeat(VALUES))), Err(Odd::Many(VALUES)));
        assert_eq!(of(format!("[{}0]", "0,".repeat(VALUES - 2))), Ok(()));
        assert_eq!(of(format!("[{}{{}}]", "{},".repeat(VALUES))), Err(Odd::Many(VALUES)));
        assert_eq!(of("[".repeat(1 << 20)), Ok(()), "its reader refuses it");
    }
}
