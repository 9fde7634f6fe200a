//! Forms with files (`multipart/form-data`, RFC 7578), read as they come: memory holds a few kilobytes of them.

use crate::Refusal;

/// Most bytes of a part's headers.
const HEAD: usize = 4 << 10;
/// Bytes asked for at once.
const CHUNK: usize = 64 << 10;
/// Longest boundary (RFC 2046).
const BOUNDARY: usize = 70;

/// A form on its way. `R` gives its bytes, and none at the end.
pub struct Multipart<R> {
    input: R,
    buffer: Vec<u8>,
    delimiter: Vec<u8>,
    ended: bool,
    in_part: bool,
}

/// What a part's headers say.
#[derive(Debug, PartialEq, Eq)]
pub struct Part {
    pub name: String,
    /// As the client sent it: never a path of ours.
    pub file: Option<String>,
}

fn malformed(what: &str) -> Refusal {
    Refusal::new(400, format!("malformed form: {what}"))
}

/// The boundary that a `Content-Type` tells.
pub fn boundary(kind: Option<&str>) -> Result<&str, Refusal> {
    let (kind, rest) = kind.unwrap_or_default().split_once(';').unwrap_or_default();
    if !kind.trim().eq_ignore_ascii_case("multipart/form-data") {
        return Err(Refusal::new(415, "expected Content-Type multipart/form-data"));
    }
    let value = rest.split(';').find_map(|p| {
        let (k, v) = p.split_once('=')?;
        k.trim().eq_ignore_ascii_case("boundary").then(|| v.trim().trim_matches('"'))
    });
    let fine = |v: &&str| !v.is_empty() && v.len() <= BOUNDARY && v.bytes().all(|b| b.is_ascii_graphic() || b == b' ');
    value.filter(fine).ok_or_else(|| malformed("the Content-Type has no boundary"))
}

fn find(haystack: &[u8], needle: &[u8]) -> Option<usize> {
    let mut from = 0;
    while let Some(at) = haystack[from..].iter().position(|b| *b == needle[0]) {
        if haystack[from + at..].starts_with(needle) {
            return Some(from + at);
        }
        from += at + 1;
    }
    None
}

impl<R: FnMut(&mut [u8]) -> Result<usize, Refusal>> Multipart<R> {
    pub fn new(input: R, boundary: &str) -> Self {
        // The first delimiter has no line before it.
        Self {
            input,
            buffer: b"\r\n".into(),
            delimiter: format!("\r\n--{boundary}").into(),
            ended: false,
            in_part: false,
        }
    }

    /// Gets more bytes; false at the end.
    fn fill(&mut self) -> Result<bool, Refusal> {
        let old = self.buffer.len();
        self.buffer.resize(old + CHUNK, 0);
        let n = (self.input)(&mut self.buffer[old..]);
        self.buffer.truncate(old + *n.as_ref().unwrap_or(&0));
        Ok(n? > 0)
    }

    /// The next part, past what is left of the last one; none at the end.
    pub fn next(&mut self) -> Result<Option<Part>, Refusal> {
        if self.ended {
            return Ok(None);
        }
        // Up to the first delimiter there may be anything; after that, the rest of a part.
        self.in_part = true;
        let mut nowhere = [0; 8 << 10];
        while self.read(&mut nowhere)? > 0 {}
        self.buffer.drain(..self.delimiter.len());
        while self.buffer.len() < 2 {
            if !self.fill()? {
                return Err(malformed("it ends within a delimiter"));
            }
        }
        if self.buffer.starts_with(b"--") {
            self.ended = true;
            return Ok(None);
        }
        let end = loop {
            if let Some(at) = find(&self.buffer[..self.buffer.len().min(HEAD)], b"\r\n\r\n") {
                break at;
            }
            if self.buffer.len() >= HEAD {
                return Err(malformed("the headers of a part are too long"));
            }
            if !self.fill()? {
                return Err(malformed("it ends within the headers of a part"));
            }
        };
        let head: Vec<u8> = self.buffer.drain(..end + 4).collect();
        let head = std::str::from_utf8(&head).map_err(|_| malformed("the headers of a part are not text"))?;
        let part = part(head)?;
        self.in_part = true;
        Ok(Some(part))
    }

    /// Some of the part's bytes; 0 at its end.
    pub fn read(&mut self, out: &mut [u8]) -> Result<usize, Refusal> {
        if !self.in_part || out.is_empty() {
            return Ok(0);
        }
        loop {
            let at = find(&self.buffer, &self.delimiter);
            if at == Some(0) {
                self.in_part = false;
                return Ok(0);
            }
            // What may be the beginning of a delimiter waits for more.
            let ready = at.unwrap_or((self.buffer.len() + 1).saturating_sub(self.delimiter.len()));
            if ready > 0 {
                let n = ready.min(out.len());
                out[..n].copy_from_slice(&self.buffer[..n]);
                self.buffer.drain(..n);
                return Ok(n);
            }
            if !self.fill()? {
                return Err(malformed("it ends without its last delimiter"));
            }
        }
    }

    /// The part's text, of at most `most` bytes.
    pub fn text(&mut self, most: usize) -> Result<String, Refusal> {
        let mut bytes = Vec::new();
        let mut chunk = [0; 4 << 10];
        loop {
            match self.read(&mut chunk)? {
                0 => return String::from_utf8(bytes).map_err(|_| malformed("a field is not text")),
                n => bytes.extend_from_slice(&chunk[..n]),
            }
            if bytes.len() > most {
                return Err(Refusal::new(413, format!("a field has more than {most} bytes")));
            }
        }
    }
}

fn part(head: &str) -> Result<Part, Refusal> {
    let line = head.split("\r\n").find_map(|line| {
        let (name, value) = line.split_once(':')?;
        name.trim().eq_ignore_ascii_case("content-disposition").then(|| value.trim())
    });
    let line = line.ok_or_else(|| malformed("a part has no Content-Disposition"))?;
    let name = parameter(line, "name").ok_or_else(|| malformed("a part has no name"))?;
    Ok(Part { name, file: parameter(line, "filename") })
}

/// `key="value"` of a header; browsers write quotes and line ends in it as `%22`, `%0D` and `%0A`.
fn parameter(line: &str, key: &str) -> Option<String> {
    let mut rest = line;
    loop {
        let (_, after) = rest.split_once(';')?;
        let (name, value) = after.split_once('=')?;
        let (value, next) = match value.trim_start().strip_prefix('"') {
            Some(quoted) => quoted.split_once('"')?,
            None => value.split_at(value.find(';').unwrap_or(value.len())),
        };
        if name.trim().eq_ignore_ascii_case(key) {
            return Some(value.trim().replace("%22", "\"").replace("%0D", "\r").replace("%0A", "\n"));
        }
        rest = next;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Gives `bytes` in pieces of `step`.
    fn pieces(bytes: Vec<u8>, step: usize) -> impl FnMut(&mut [u8]) -> Result<usize, Refusal> {
        let mut at = 0;
        move |out| {
            let n = step.min(out.len()).min(bytes.len() - at);
            out[..n].copy_from_slice(&bytes[at..at + n]);
            at += n;
            Ok(n)
        }
    }

    fn all(
        form: &mut Multipart<impl FnMut(&mut [u8]) -> Result<usize, Refusal>>,
    ) -> Result<Vec<(Part, Vec<u8>)>, Refusal> {
        let mut found = Vec::new();
        while let Some(part) = form.next()? {
            let mut bytes = Vec::new();
            let mut chunk = [0; 7];
            while let n @ 1.. = form.read(&mut chunk)? {
                bytes.extend_from_slice(&chunk[..n]);
            }
            found.push((part, bytes));
        }
        Ok(found)
    }

    proptest! {
        #[test]
        fn what_was_sent_is_read(files in prop::collection::vec(prop::collection::vec(0u8..64, 0..300), 0..5), step in 1usize..40) {
            // Bytes below 64 hold line ends and dashes: near misses of the delimiter are frequent.
            let mut bytes = Vec::new();
            for (i, file) in files.iter().enumerate() {
                bytes.extend(format!("--\r-\r\nContent-Disposition: form-data; name=\"f{i}\"; filename=\"a/{i};x.png\"\r\n\r\n").bytes());
                bytes.extend(file);
                bytes.extend(b"\r\n");
            }
            bytes.extend(b"--\r---\r\n");
            prop_assume!(files.iter().all(|f| find(f, b"\r\n--\r-").is_none()));
            let found = all(&mut Multipart::new(pieces(bytes, step), "\r-")).unwrap();
            prop_assert_eq!(found.len(), files.len());
            for (i, ((part, read), sent)) in found.iter().zip(&files).enumerate() {
                prop_assert_eq!(part, &Part { name: format!("f{i}"), file: Some(format!("a/{i};x.png")) });
                prop_assert_eq!(read, sent);
            }
        }

        #[test]
        fn anything_at_all_is_an_answer_or_an_error(bytes in prop::collection::vec(any::<u8>(), 0..600), step in 1usize..100) {
            let _ = all(&mut Multipart::new(pieces(bytes, step), "x"));
        }
    }

    #[test]
    fn forms_that_end_early_are_refused() {
        let whole = b"--x\r\nContent-Disposition: form-data; name=\"a\"\r\n\r\nvalue\r\n--x--";
        for end in 0..whole.len() {
            let cut = whole[..end].to_vec();
            assert!(all(&mut Multipart::new(pieces(cut, 9), "x")).is_err(), "cut at {end}");
        }
        let found = all(&mut Multipart::new(pieces(whole.to_vec(), 9), "x")).unwrap();
        assert_eq!(found, [(Part { name: "a".into(), file: None }, b"value".to_vec())]);
        let mut endless = Multipart::new(pieces(["--x\r\n".as_bytes(), &[b'a'; 9000]].concat(), 999), "x");
        assert!(endless.next().unwrap_err().text.contains("too long"));
        assert!(boundary(Some("multipart/form-data; boundary=\"q r\"")).is_ok_and(|b| b == "q r"));
        assert_eq!(boundary(Some("text/plain")).unwrap_err().status, 415);
        assert!(boundary(Some(&format!("multipart/form-data; boundary={}", "x".repeat(71)))).is_err());
    }
}
