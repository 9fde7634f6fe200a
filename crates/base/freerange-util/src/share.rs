//! Parts of a list for several processes.

use std::str::FromStr;

/// Which part of a numbered lot of work a process does: the numbers that leave the remainder `index` when divided by
/// `count`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Share {
    /// Number of this process, from 0.
    pub index: u64,
    /// Number of processes.
    pub count: u64,
}

impl Default for Share {
    fn default() -> Self {
        Self { index: 0, count: 1 }
    }
}

impl Share {
    /// Whether the piece of work with this number is its own.
    pub fn contains(self, number: u64) -> bool {
        number % self.count == self.index
    }
}

impl FromStr for Share {
    type Err = String;

    /// `i/n` with `i < n`, such as `$SLURM_ARRAY_TASK_ID/$SLURM_ARRAY_TASK_COUNT`.
    fn from_str(text: &str) -> Result<Self, String> {
        let parsed = text.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
        match parsed {
            Some((index, count)) if index < count => Ok(Self { index, count }),
            _ => Err(format!("expected i/n with i from 0 to n - 1, such as 0/8, found {text:?}")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_are_parsed_strictly() {
        assert_eq!("3/8".parse(), Ok(Share { index: 3, count: 8 }));
        for text in ["", "3", "8/8", "-1/2", "0/0", "1/2/3", "a/b"] {
            assert!(text.parse::<Share>().unwrap_err().contains("i/n"), "{text}");
        }
    }

    #[test]
    fn shares_divide_the_work() {
        for number in 0..10 {
            let owners = (0..3).filter(|&index| Share { index, count: 3 }.contains(number)).count();
            assert_eq!(owners, 1, "{number}");
        }
        assert!((0..10).all(|number| Share::default().contains(number)));
    }
}
