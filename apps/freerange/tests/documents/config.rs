//! The reference of the configuration: fields and descriptions from the sources, defaults from the types themselves.

use std::collections::BTreeMap;

use freerange::{Choices, DeviceName, Reconstructor};
use freerange_data::build::MakingConfig;
use freerange_train::config::TrainConfig;
use serde_json::Value;
use syn::{Attribute, Expr, Fields, GenericArgument, Item, ItemEnum, ItemStruct, Lit, Meta, PathArguments, Type};

use super::pages::{cell, files, wrap};

/// The smallest training configuration: what it leaves out has its default.
const SMALLEST: &str = "[model]\n[data]\n[refiner]\n[[stage]]\ndepth = 10\nimage_size = 504\nbatch = 1\nsteps = 1\n";

/// A type that configurations are made of, and the folder of its crate.
struct Known {
    item: Item,
    place: String,
}

/// All types of the crates that can be read from a file, by name.
struct Types(BTreeMap<String, Vec<Known>>);

impl Types {
    fn read() -> Self {
        let mut all: BTreeMap<String, Vec<Known>> = BTreeMap::new();
        for source in files(&["rs"]).into_iter().filter(|s| s.name.starts_with("crates/") && s.name.contains("/src/")) {
            let place = source.name.split("/src/").next().unwrap().to_owned();
            for item in syn::parse_file(&source.text).unwrap().items {
                let (name, attributes) = match &item {
                    Item::Struct(s) => (s.ident.to_string(), &s.attrs),
                    Item::Enum(e) => (e.ident.to_string(), &e.attrs),
                    _ => continue,
                };
                let reads = attributes.iter().any(|a| a.path().is_ident("derive") && list(a).contains("Deserialize"));
                if reads {
                    all.entry(name).or_default().push(Known { item, place: place.clone() });
                }
            }
        }
        Self(all)
    }

    /// The type of this name that a type of the crate at `place` means: its own, or the only one.
    fn get(&self, name: &str, place: &str) -> Option<&Known> {
        let known = self.0.get(name)?;
        let own = known.iter().find(|k| k.place == place);
        assert!(own.is_some() || known.len() == 1, "{name}, used in {place}, is in several crates");
        own.or(known.first())
    }
}

/// What stands in an attribute's parentheses.
fn list(attribute: &Attribute) -> String {
    match &attribute.meta {
        Meta::List(list) => list.tokens.to_string(),
        _ => String::new(),
    }
}

/// The `#[serde(...)]` of an item, as text.
fn serde_of(attributes: &[Attribute]) -> String {
    attributes.iter().filter(|a| a.path().is_ident("serde")).map(list).collect::<Vec<_>>().join(", ")
}

/// `value` of `name = "value"` in serde's attribute.
fn setting(serde: &str, name: &str) -> Option<String> {
    let rest = serde.split_once(&format!("{name} = \""))?.1;
    Some(rest.split_once('"')?.0.to_owned())
}

/// Documentation in one line, links to code as their text.
fn docs(attributes: &[Attribute]) -> String {
    let lines = attributes.iter().filter(|a| a.path().is_ident("doc")).filter_map(|a| match &a.meta {
        Meta::NameValue(pair) => match &pair.value {
            Expr::Lit(literal) => match &literal.lit {
                Lit::Str(text) => Some(text.value()),
                _ => None,
            },
            _ => None,
        },
        _ => None,
    });
    let text = lines.collect::<Vec<_>>().join(" ").split_whitespace().collect::<Vec<_>>().join(" ");
    without_links(&text)
}

/// ``[`x`](y)`` and ``[`x`]`` become `` `x` ``, `[x](y)` becomes `x`. Lists of numbers stay.
fn without_links(text: &str) -> String {
    let mut out = String::new();
    let mut rest = text;
    while let Some(at) = rest.find('[') {
        out += &rest[..at];
        let Some(end) = rest[at..].find(']').map(|e| at + e) else { break };
        let (inside, after) = (&rest[at + 1..end], &rest[end + 1..]);
        let target = after.strip_prefix('(').and_then(|t| t.split_once(')'));
        rest = match target {
            Some((_, after)) => after,
            None => after,
        };
        out += &if target.is_some() || inside.starts_with('`') { inside.to_owned() } else { format!("[{inside}]") };
    }
    out + rest
}

fn snake(name: &str) -> String {
    let mut out = String::new();
    for (i, c) in name.chars().enumerate() {
        if c.is_uppercase() && i > 0 {
            out.push('_');
        }
        out.extend(c.to_lowercase());
    }
    out
}

/// A variant as files name it.
fn variant_name(item: &ItemEnum, variant: &syn::Variant) -> String {
    if let Some(name) = setting(&serde_of(&variant.attrs), "rename") {
        return name;
    }
    let name = variant.ident.to_string();
    match setting(&serde_of(&item.attrs), "rename_all").as_deref() {
        Some("snake_case") => snake(&name),
        Some("lowercase") => name.to_lowercase(),
        None => name,
        Some(other) => panic!("{}: rename_all = {other:?} is not known here", item.ident),
    }
}

/// The last name of a type's path and its argument: `Option` and `u32` of `Option<u32>`.
fn named(ty: &Type) -> Option<(String, Option<&Type>)> {
    let Type::Path(path) = ty else { return None };
    let last = path.path.segments.last()?;
    let argument = match &last.arguments {
        PathArguments::AngleBracketed(arguments) => arguments.args.iter().find_map(|a| match a {
            GenericArgument::Type(inner) => Some(inner),
            _ => None,
        }),
        _ => None,
    };
    Some((last.ident.to_string(), argument))
}

/// A field's type without `Option` and `Vec`, and whether it was optional and a list.
fn bare(ty: &Type) -> (&Type, bool, bool) {
    match named(ty) {
        Some((name, Some(inner))) if name == "Option" => (bare(inner).0, true, bare(inner).2),
        Some((name, Some(inner))) if name == "Vec" => (bare(inner).0, false, true),
        _ => (ty, false, false),
    }
}

/// What kind of value a field takes.
fn kind(ty: &Type) -> String {
    match ty {
        Type::Tuple(tuple) => format!("{} numbers", tuple.elems.len()),
        Type::Array(array) => match &array.len {
            Expr::Lit(literal) => match &literal.lit {
                Lit::Int(n) => format!("{n} numbers"),
                _ => "numbers".into(),
            },
            _ => "a number per channel".into(),
        },
        _ => match named(ty).map(|(name, _)| name).as_deref() {
            Some("bool") => "true, false",
            Some("f32" | "f64") => "number",
            Some("String" | "PathBuf") => "text",
            Some("u8" | "u16" | "u32" | "u64" | "usize" | "i32" | "i64") => "integer",
            _ => "",
        }
        .into(),
    }
}

/// A value as a file has it; numbers of 32 bits without what 64 bits add to them.
fn shown(value: &Value) -> String {
    match value {
        Value::Null => String::new(),
        Value::Number(n) if n.is_f64() => {
            let v = n.as_f64().unwrap();
            let short = v as f32;
            if f64::from(short) == v { format!("{short:?}") } else { format!("{v:?}") }
        }
        Value::Array(values) => format!("[{}]", values.iter().map(shown).collect::<Vec<_>>().join(", ")),
        Value::Object(fields) => {
            let fields = fields.iter().filter(|(_, v)| !v.is_null()).map(|(k, v)| format!("{k} = {}", shown(v)));
            format!("{{ {} }}", fields.collect::<Vec<_>>().join(", "))
        }
        other => other.to_string(),
    }
}

/// Writes tables, and after each those of the tables within it.
struct Writer<'a> {
    types: &'a Types,
    out: String,
}

impl Writer<'_> {
    fn heading(&mut self, path: &str, many: bool, about: &str) {
        if path.is_empty() {
            return;
        }
        let name = if many { format!("[[{path}]]") } else { format!("[{path}]") };
        self.out += &format!("\n### `{name}`\n\n{}\n", wrap(about));
    }

    /// A struct at `path` with its values, which are null where there are none.
    fn table(&mut self, path: &str, many: bool, item: &ItemStruct, place: &str, values: &Value) {
        self.heading(path, many, &docs(&item.attrs));
        let mut inner = Vec::new();
        let rows = self.rows(item, place, values, path, &mut inner);
        self.write_rows(&rows);
        for (path, many, ty, place, value) in inner {
            match &self.types.get(&ty, &place).unwrap().item {
                Item::Struct(item) => self.table(&path, many, item, &place_of(self.types, &ty, &place), &value),
                Item::Enum(item) => self.choices(&path, item, &place_of(self.types, &ty, &place), &value),
                _ => unreachable!("only structs and enums are kept"),
            }
        }
    }

    fn write_rows(&mut self, rows: &str) {
        if !rows.is_empty() {
            self.out += &format!("\n| key | value | default | |\n|---|---|---|---|\n{rows}");
        }
    }

    fn rows(&self, item: &ItemStruct, place: &str, values: &Value, path: &str, inner: &mut Vec<Inner>) -> String {
        let mut rows = String::new();
        let all_default = serde_of(&item.attrs).contains("default");
        let Fields::Named(fields) = &item.fields else { panic!("{}: named fields expected", item.ident) };
        for field in &fields.named {
            let serde = serde_of(&field.attrs);
            let (ty, optional, many) = bare(&field.ty);
            let mut ty_name = named(ty).map(|(name, _)| name).unwrap_or_default();
            if serde.contains("flatten") {
                assert_eq!(ty_name, "M", "the only flattened field is how objects are made");
                ty_name = "MakingConfig".into();
                let known = self.types.get(&ty_name, place).unwrap();
                let Item::Struct(item) = &known.item else { panic!("a struct expected") };
                rows += &self.rows(item, &known.place, values, path, inner);
                continue;
            }
            let name = setting(&serde, "rename").unwrap_or_else(|| field.ident.as_ref().unwrap().to_string());
            let value = values.get(&name).cloned().unwrap_or(Value::Null);
            let full = if path.is_empty() { name.clone() } else { format!("{path}.{name}") };
            let known = self.types.get(&ty_name, place);
            let values_of = match known.map(|k| &k.item) {
                Some(Item::Struct(_)) => {
                    inner.push((full, many, ty_name, place.into(), if many { Value::Null } else { value }));
                    continue;
                }
                Some(Item::Enum(item)) if setting(&serde_of(&item.attrs), "tag").is_some() => {
                    inner.push((full, many, ty_name, place.into(), value));
                    continue;
                }
                Some(Item::Enum(_)) => "one of".to_owned(),
                _ => format!("{}{}", if many { "list of: " } else { "" }, kind(ty)),
            };
            let may_be_left_out = optional || all_default || serde.contains("default");
            let default = match &value {
                Value::Null if may_be_left_out => String::new(),
                Value::Null => "required".into(),
                value => format!("`{}`", shown(value)),
            };
            let mut about = docs(&field.attrs);
            if let Some(Item::Enum(item)) = known.map(|k| &k.item) {
                about += &format!(" {}", variants(item));
            }
            rows += &format!("| `{name}` | {} | {} | {} |\n", cell(&values_of), cell(&default), cell(&about));
        }
        rows
    }

    /// A table whose field `kind` chooses among others.
    fn choices(&mut self, path: &str, item: &ItemEnum, place: &str, value: &Value) {
        let tag = setting(&serde_of(&item.attrs), "tag").unwrap();
        self.heading(path, false, &docs(&item.attrs));
        let chosen = value.get(&tag).and_then(Value::as_str).unwrap_or_default();
        self.write_rows(&format!("| `{tag}` | | `\"{chosen}\"` | {} |\n", cell(&variants(item))));
        for variant in &item.variants {
            let Some(field) = variant.fields.iter().next() else { continue };
            let (name, ty) = (variant_name(item, variant), named(&field.ty).unwrap().0);
            let known = self.types.get(&ty, place).unwrap();
            let Item::Struct(item) = &known.item else { panic!("a struct expected") };
            self.out += &format!("\nWith `{tag} = \"{name}\"`:\n");
            let values = if name == chosen { value.clone() } else { Value::Null };
            let rows = self.rows(item, &known.place, &values, path, &mut Vec::new());
            self.write_rows(&rows);
        }
    }
}

/// Path, whether there are several, name of the type, crate that names it, value.
type Inner = (String, bool, String, String, Value);

fn place_of(types: &Types, name: &str, place: &str) -> String {
    types.get(name, place).unwrap().place.clone()
}

/// Each variant and what it means.
fn variants(item: &ItemEnum) -> String {
    let all = item.variants.iter().map(|variant| {
        let name = variant_name(item, variant);
        let fields: Vec<String> = match &variant.fields {
            Fields::Named(fields) => {
                let one = |f: &syn::Field| format!("`{}`: {}", f.ident.as_ref().unwrap(), docs(&f.attrs));
                fields.named.iter().map(one).collect()
            }
            _ => Vec::new(),
        };
        let fields = if fields.is_empty() { String::new() } else { format!(" ({})", fields.join(" ")) };
        format!("`\"{name}\"`: {}{fields}", docs(&variant.attrs))
    });
    all.collect::<Vec<_>>().join(" ")
}

/// Paths and values of all fields of a pipeline.
fn leaves(value: &Value, path: &str, found: &mut Vec<(String, Value)>) {
    match value.as_object() {
        Some(fields) => {
            for (name, value) in fields {
                leaves(value, &if path.is_empty() { name.clone() } else { format!("{path}.{name}") }, found);
            }
        }
        None => found.push((path.into(), value.clone())),
    }
}

/// Documentation of the field at a path below a struct.
fn described(types: &Types, root: &str, path: &str) -> String {
    let (mut ty, mut place, mut text) = (root.to_owned(), "crates/freerange".to_owned(), String::new());
    for name in path.split('.') {
        let known = types.get(&ty, &place).unwrap_or_else(|| panic!("{path}: no type {ty}"));
        let Item::Struct(item) = &known.item else { panic!("{path}: {ty} is no struct") };
        let field = item.fields.iter().find(|f| f.ident.as_ref().is_some_and(|i| i == name));
        let field = field.unwrap_or_else(|| panic!("{path}: {ty} has no field {name}"));
        text = docs(&field.attrs);
        place.clone_from(&known.place);
        ty = named(bare(&field.ty).0).unwrap_or_default().0;
    }
    if let Some(Item::Enum(item)) = types.get(&ty, &place).map(|k| &k.item) {
        text += &format!(" {}", variants(item));
    }
    text
}

/// The page.
pub fn page() -> String {
    let types = Types::read();
    let mut out = String::from(
        "<!-- Generated from the sources: UPDATE=1 cargo test --release -p freerange-cli reference -->\n\n# Configuration\n\n\
         Settings of [reconstruction](#pipeline) and of [training](#training), with their defaults.\n\n## Pipeline\n\n\
         Keys of `--set KEY=VALUE` (`reconstruct`, `serve`, `eval`), and of `pipeline` in `report.json`. Defaults are\n\
         those of the built-in model with `--quality default`.\n\n| key | default | |\n|---|---|---|\n",
    );
    let model = Reconstructor::shipped(&DeviceName::Cpu.open().unwrap()).unwrap();
    let pipeline = model.options_of(&Choices::default()).unwrap().pipeline;
    let mut fields = Vec::new();
    leaves(&serde_json::to_value(&pipeline).unwrap(), "", &mut fields);
    for (path, value) in fields {
        let about = described(&types, "PipelineConfig", &path);
        let value = shown(&value);
        let value = if value.is_empty() { value } else { format!("`{value}`") };
        out += &format!("| `{path}` | {} | {} |\n", cell(&value), cell(&about));
    }
    out += "\n## Training\n\n";
    out += &wrap(
        "A training configuration is one TOML file, such as `configs/tiny.toml`; its defaults are the paper's. With `parent` \
         it holds only the differences from another file: tables are merged key by key, lists are replaced. Unknown keys \
         are refused. Paths are relative to the file.",
    );
    let config: TrainConfig<MakingConfig> = toml::from_str(SMALLEST).unwrap();
    let Item::Struct(item) = &types.get("TrainConfig", "").unwrap().item else { panic!("a struct expected") };
    let place = place_of(&types, "TrainConfig", "");
    let mut writer = Writer { types: &types, out: format!("{out}\n") };
    writer.table("", false, item, &place, &serde_json::to_value(&config).unwrap());
    writer.out
}

#[test]
fn types_are_read_as_serde_reads_them() {
    assert_eq!(snake("OneSide"), "one_side");
    assert_eq!(setting("rename = \"stage\", default", "rename").as_deref(), Some("stage"));
    assert_eq!(without_links("[`A`](b::A), [text](x), [`C`] and [0, 1]"), "`A`, text, `C` and [0, 1]");
    assert_eq!(shown(&serde_json::json!({"a": [0.05f32, 1e-6], "b": null})), "{ a = [0.05, 1e-6] }");
}
