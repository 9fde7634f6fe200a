//! The text of OpenUSD's layers, as much of it as prims with attributes need. What is not understood within brackets is
//! passed over; attributes that change with time have no value here.

use freerange_util::Invalid;

use crate::formats::error::{CUT_OFF, problem};

/// Prims within each other, at most.
const MOST_NESTED: usize = 64;

/// A layer.
#[derive(Debug, Default)]
pub struct Layer {
    /// What stands in brackets at the top.
    pub metadata: Vec<(String, Value)>,
    /// Prims, parents before their children.
    pub prims: Vec<Prim>,
}

/// A prim, as it is defined or changed here.
#[derive(Debug, Default)]
pub struct Prim {
    pub path: String,
    /// `def`, `over` or `class`.
    pub specifier: String,
    /// Its schema; empty for none.
    pub kind: String,
    pub attributes: Vec<(String, Value)>,
    /// The number of its parent.
    pub parent: Option<usize>,
}

/// A value: numbers in the order of the text, however they are bracketed, or words.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Value {
    pub numbers: Vec<f64>,
    /// Numbers in each innermost bracket: 3 of vectors, 1 without brackets; 0 where they differ.
    pub width: usize,
    pub words: Vec<String>,
}

/// The value of the last attribute of this name.
pub fn find<'a>(values: &'a [(String, Value)], name: &str) -> Option<&'a Value> {
    values.iter().rev().find(|(n, _)| n == name).map(|(_, value)| value)
}

#[derive(Clone, Debug, PartialEq)]
enum Token<'a> {
    /// A name, a number, a path in angles or an asset between @.
    Word(&'a str),
    Text(&'a str),
    Mark(char),
    Line,
    End,
}

pub fn parse(text: &str) -> Result<Layer, Invalid> {
    if !text.starts_with("#usda 1.") {
        let found: String = text.chars().take(20).collect();
        return Err(problem("layer", "a text layer of OpenUSD (\"#usda 1.0\")", format!("{found:?}")));
    }
    let mut parser = Parser { text, at: 0, line: 1 };
    let mut layer = Layer::default();
    parser.skip_lines()?;
    if parser.peek()? == Token::Mark('(') {
        parser.next()?;
        layer.metadata = parser.statements(')')?;
    }
    loop {
        match parser.next()? {
            Token::End => return Ok(layer),
            Token::Line => {}
            Token::Word(specifier @ ("def" | "over" | "class")) => parser.prim(specifier, None, 0, &mut layer)?,
            // As in a list of the order of prims.
            _ => parser.rest_of_line()?,
        }
    }
}

struct Parser<'a> {
    text: &'a str,
    at: usize,
    line: usize,
}

impl<'a> Parser<'a> {
    fn wrong(&self, expected: &str, found: &str) -> Invalid {
        let found: String = found.chars().take(40).collect();
        // Whole files end with a line.
        let why = if self.text[self.at..].contains('\n') { String::new() } else { format!(": {CUT_OFF}") };
        problem(format!("layer, line {}", self.line), expected, format!("{found:?}{why}"))
    }

    fn peek(&mut self) -> Result<Token<'a>, Invalid> {
        let (at, line) = (self.at, self.line);
        let token = self.next();
        (self.at, self.line) = (at, line);
        token
    }

    fn skip_lines(&mut self) -> Result<(), Invalid> {
        while self.peek()? == Token::Line {
            self.next()?;
        }
        Ok(())
    }

    fn next(&mut self) -> Result<Token<'a>, Invalid> {
        let bytes = self.text.as_bytes();
        loop {
            match bytes.get(self.at) {
                Some(b' ' | b'\t' | b'\r') => self.at += 1,
                Some(b'#') => self.at += self.text[self.at..].find('\n').unwrap_or(self.text.len() - self.at),
                _ => break,
            }
        }
        let rest = &self.text[self.at..];
        let Some(first) = rest.chars().next() else { return Ok(Token::End) };
        match first {
            '\n' => {
                self.at += 1;
                self.line += 1;
                Ok(Token::Line)
            }
            '"' | '\'' => self.string(first),
            '@' | '<' => {
                let close = if first == '@' { '@' } else { '>' };
                let Some(end) = rest[1..].find(close) else { return Err(self.wrong("the end of a reference", rest)) };
                self.at += end + 2;
                Ok(Token::Word(&rest[..end + 2]))
            }
            '(' | ')' | '[' | ']' | '{' | '}' | '=' | ',' | ';' => {
                self.at += 1;
                Ok(Token::Mark(first))
            }
            _ => {
                let ends = |c: char| c.is_whitespace() || "()[]{}=,;\"'@<#".contains(c);
                let end = rest.find(ends).unwrap_or(rest.len());
                if end == 0 {
                    return Err(self.wrong("a name, a number or a bracket", rest));
                }
                self.at += end;
                Ok(Token::Word(&rest[..end]))
            }
        }
    }

    /// A text in quotes, or in three of them; with what is escaped in it left as it is.
    fn string(&mut self, quote: char) -> Result<Token<'a>, Invalid> {
        let rest = &self.text[self.at..];
        let three: String = std::iter::repeat_n(quote, 3).collect();
        let (width, long) = if rest.starts_with(&three) { (3, true) } else { (1, false) };
        let body = &rest[width..];
        let mut from = 0;
        while let Some(found) = body[from..].find(['\\', quote, '\n']) {
            let at = from + found;
            match body.as_bytes()[at] {
                b'\\' => from = at + 1 + body[at + 1..].chars().next().map_or(0, char::len_utf8),
                b'\n' if !long => break,
                b'\n' => from = at + 1,
                _ if long && !body[at..].starts_with(&three) => from = at + 1,
                _ => {
                    self.line += body[..at].matches('\n').count();
                    self.at += width + at + width;
                    return Ok(Token::Text(&body[..at]));
                }
            }
        }
        Err(self.wrong("the end of a text in quotes", rest))
    }

    /// `[TYPE] "NAME" [(..)] { .. }` after its specifier.
    fn prim(&mut self, specifier: &str, parent: Option<usize>, depth: usize, layer: &mut Layer) -> Result<(), Invalid> {
        if depth > MOST_NESTED {
            return Err(self.wrong(&format!("prims at most {MOST_NESTED} deep"), "more"));
        }
        let mut token = self.next()?;
        let mut kind = "";
        if let Token::Word(word) = token {
            kind = word;
            token = self.next()?;
        }
        let Token::Text(name) = token else {
            return Err(self.wrong("the name of a prim in quotes", &format!("{token:?}")));
        };
        let above = parent.map_or("", |p| &layer.prims[p].path);
        let prim = Prim {
            path: format!("{above}/{name}"),
            specifier: specifier.into(),
            kind: kind.into(),
            attributes: Vec::new(),
            parent,
        };
        let number = layer.prims.len();
        layer.prims.push(prim);
        self.skip_lines()?;
        if self.peek()? == Token::Mark('(') {
            self.next()?;
            self.pass_over(')')?;
            self.skip_lines()?;
        }
        match self.next()? {
            Token::Mark('{') => {}
            other => return Err(self.wrong("{ and the body of a prim", &format!("{other:?}"))),
        }
        loop {
            match self.peek()? {
                Token::Mark('}') => {
                    self.next()?;
                    return Ok(());
                }
                Token::Word(specifier @ ("def" | "over" | "class")) => {
                    self.next()?;
                    self.prim(specifier, Some(number), depth + 1, layer)?;
                }
                Token::End => return Err(self.wrong("} at the end of a prim", "the end of the text")),
                _ => layer.prims[number].attributes.extend(self.statement('}')?),
            }
        }
    }

    /// Statements up to `close`, which is taken.
    fn statements(&mut self, close: char) -> Result<Vec<(String, Value)>, Invalid> {
        let mut all = Vec::new();
        loop {
            match self.peek()? {
                Token::Mark(mark) if mark == close => {
                    self.next()?;
                    return Ok(all);
                }
                Token::End => return Err(self.wrong(&format!("{close:?}"), "the end of the text")),
                _ => all.extend(self.statement(close)?),
            }
        }
    }

    /// A line, or what is left of it before `close`: words, the last of which is a name, and a value, if there is one.
    fn statement(&mut self, close: char) -> Result<Option<(String, Value)>, Invalid> {
        let mut name = None;
        loop {
            match self.peek()? {
                Token::Mark(mark) if mark == close => return Ok(None),
                Token::End => return Ok(None),
                Token::Line | Token::Mark(';') => {
                    self.next()?;
                    return Ok(None);
                }
                Token::Word(word) => {
                    self.next()?;
                    name = Some(word.to_owned());
                }
                Token::Mark('=') => {
                    self.next()?;
                    let value = self.value()?;
                    self.rest_of_statement(close)?;
                    return Ok(name.zip(value));
                }
                Token::Mark('(') => {
                    self.next()?;
                    self.pass_over(')')?;
                }
                // The brackets of an array's type; a set of variants.
                Token::Mark('[') => {
                    self.next()?;
                    self.pass_over(']')?;
                }
                Token::Mark('{') => {
                    self.next()?;
                    self.pass_over('}')?;
                }
                Token::Text(_) => {
                    self.next()?;
                }
                other => return Err(self.wrong("a statement", &format!("{other:?}"))),
            }
        }
    }

    /// Metadata after a value, and the end of its line.
    fn rest_of_statement(&mut self, close: char) -> Result<(), Invalid> {
        loop {
            match self.peek()? {
                Token::End => return Ok(()),
                Token::Mark(mark) if mark == close => return Ok(()),
                Token::Line | Token::Mark(';') => {
                    self.next()?;
                    return Ok(());
                }
                Token::Mark('(') => {
                    self.next()?;
                    self.pass_over(')')?;
                }
                other => return Err(self.wrong("the end of the line after a value", &format!("{other:?}"))),
            }
        }
    }

    fn rest_of_line(&mut self) -> Result<(), Invalid> {
        while !matches!(self.peek()?, Token::Line | Token::End) {
            self.next()?;
        }
        Ok(())
    }

    /// All up to the bracket that closes one that was opened.
    fn pass_over(&mut self, close: char) -> Result<(), Invalid> {
        let mut open = vec![close];
        while let Some(&expected) = open.last() {
            match self.next()? {
                Token::Mark('(') => open.push(')'),
                Token::Mark('[') => open.push(']'),
                Token::Mark('{') => open.push('}'),
                Token::Mark(mark) if mark == expected => drop(open.pop()),
                Token::Mark(mark) if ")]}".contains(mark) => {
                    return Err(self.wrong(&format!("{expected:?}"), &mark.to_string()));
                }
                Token::End => return Err(self.wrong(&format!("{expected:?}"), "the end of the text")),
                _ => {}
            }
        }
        Ok(())
    }

    /// A number, a word, or what is in brackets; none of a dictionary and of `None`.
    fn value(&mut self) -> Result<Option<Value>, Invalid> {
        let mut value = Value::default();
        let mut open: Vec<char> = Vec::new();
        let mut inner = 0; // numbers since the last bracket
        let mut widths: Option<usize> = None;
        loop {
            match self.next()? {
                Token::Mark('{') => {
                    self.pass_over('}')?;
                    return Ok(None);
                }
                Token::Mark('(') => {
                    open.push(')');
                    inner = 0;
                }
                Token::Mark('[') => open.push(']'),
                Token::Mark(mark) if open.last() == Some(&mark) => {
                    open.pop();
                    if mark == ')' && inner > 0 {
                        widths = Some(if widths.is_none_or(|w| w == inner) { inner } else { 0 });
                        inner = 0;
                    }
                }
                Token::Mark(',') if !open.is_empty() => {}
                Token::Line if !open.is_empty() => {}
                Token::Text(text) => value.words.push(text.into()),
                Token::Word("None") if open.is_empty() => return Ok(None),
                Token::Word(word) => match word.parse() {
                    Ok(number) => {
                        value.numbers.push(number);
                        inner += 1;
                    }
                    Err(_) => value.words.push(word.into()),
                },
                other => return Err(self.wrong("a value", &format!("{other:?}"))),
            }
            if open.is_empty() {
                value.width = widths.unwrap_or(1);
                return Ok(Some(value));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "#usda 1.0\n(\n    doc = \"\"\"two\nlines \\\" and (a bracket\"\"\"\n    upAxis = \"Z\"\n    customLayerData = {\n        int a = 3\n    }\n)\n\n\
        # a comment {\ndef Xform \"World\" (\n    kind = \"component\"\n)\n{\n    double3 xformOp:translate = (1, 2.5, -3e-2)\n    \
        uniform token[] xformOpOrder = [\"xformOp:translate\", \"xformOp:scale\"]\n    rel material = </World/M>\n    custom asset file = @a.png@\n\n    \
        def Points \"P\"\n    {\n        point3f[] points = [(1, 2, 3),\n            (4, 5, inf)] (\n            interpolation = \"vertex\"\n        )\n        \
        float[] widths = []\n        float[] w2.timeSamples = {\n            0: [1, 2],\n        }\n        float unset\n        int n = 4; half h = 0.5\n    }\n    variantSet \"v\" = {\n        \"a\" {\n            int n = 9\n        }\n    }\n}\n";

    #[test]
    fn prims_and_attributes_of_a_layer() {
        let layer = parse(TEXT).unwrap();
        assert_eq!(find(&layer.metadata, "upAxis").unwrap().words, ["Z"]);
        let paths: Vec<_> = layer.prims.iter().map(|p| (&*p.path, &*p.kind, p.parent)).collect();
        assert_eq!(paths, [("/World", "Xform", None), ("/World/P", "Points", Some(0))]);
        let get = |prim: usize, name: &str| find(&layer.prims[prim].attributes, name).cloned();
        let place = get(0, "xformOp:translate").unwrap();
        assert_eq!((place.numbers, place.width), (vec![1.0, 2.5, -0.03], 3));
        assert_eq!(get(0, "xformOpOrder").unwrap().words, ["xformOp:translate", "xformOp:scale"]);
        let points = get(1, "points").unwrap();
        assert_eq!((points.numbers, points.width), (vec![1.0, 2.0, 3.0, 4.0, 5.0, f64::INFINITY], 3));
        assert_eq!(get(1, "widths").unwrap(), Value { width: 1, ..Value::default() });
        assert!(get(1, "w2").is_none() && get(1, "unset").is_none());
        assert_eq!((get(1, "n").unwrap().numbers, get(1, "h").unwrap().numbers), (vec![4.0], vec![0.5]));
    }

    #[test]
    fn broken_layers_say_where() {
        let says = |text: &str, words: &[&str]| {
            let error = parse(text).unwrap_err().to_string();
            words.iter().for_each(|w| assert!(error.contains(w), "{w:?} in {error}"));
        };
        says("#usda 2", &["#usda 1.0"]);
        says("#usda 1.0\ndef X \"a\"\n{\n", &["line 4", "at the end of a prim"]);
        says("#usda 1.0\ndef X a\n", &["line 2", "name of a prim in quotes"]);
        says("#usda 1.0\ndef X \"a\n\"{}", &["line 2", "the end of a text in quotes"]);
        says("#usda 1.0\ndef X \"a\" {\nint[] n = [1, (2]\n}", &["line 3", "a value"]);
        says("#usda 1.0\ndef X \"a\" {\nint n = 1 2\n}", &["line 3", "the end of the line"]);
        says(&("#usda 1.0\n".to_owned() + &"def X \"a\" {".repeat(100)), &["at most 64 deep"]);
        says(&("#usda 1.0\ndef X \"a\" {\nint[] n = ".to_owned() + &"[".repeat(100_000)), &["a value", "End"]);
        // Of arrays whose parts are of different lengths, no width is known.
        let layer = parse("#usda 1.0\ndef X \"a\" {\nfloat3[] n = [(1, 2, 3), (4, 5)]\n}").unwrap();
        assert_eq!(find(&layer.prims[0].attributes, "n").unwrap().width, 0);
    }
}
