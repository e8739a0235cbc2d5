//! A TOML file whose every complaint has a place.
//!
//! What can go wrong: [`Error`] names the file, the line, the field and the value.

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::Error;

pub(super) fn parse(source: Source<'_>) -> Result<Spanned<DeTable<'_>>, Error> {
    DeTable::parse(source.text).map_err(|error| {
        let start = error.span().map_or(0, |span| span.start);
        source.error(start, "", error.message().to_string())
    })
}

pub(super) fn root<'a>(source: Source<'a>, parsed: &'a Spanned<DeTable<'a>>) -> Table<'a> {
    Table { source, path: String::new(), at: parsed.span().start, table: parsed.get_ref() }
}

/// The text and its name, for line numbers.
#[derive(Clone, Copy)]
pub(super) struct Source<'a> {
    pub(super) file: &'a str,
    pub(super) text: &'a str,
}

impl Source<'_> {
    fn error(&self, byte: usize, field: &str, what: String) -> Error {
        let before = self.text.get(..byte).unwrap_or(self.text);
        let line = 1 + before.matches('\n').count();
        Error { file: self.file.to_string(), line, field: field.to_string(), what }
    }
}

/// A table and where it stands.
pub(super) struct Table<'a> {
    source: Source<'a>,
    path: String,
    at: usize,
    table: &'a DeTable<'a>,
}

/// A value's place, for reading it.
pub(super) struct At<'a> {
    pub(super) source: Source<'a>,
    field: String,
}

impl<'a> Table<'a> {
    fn field(&self, key: &str) -> String {
        if self.path.is_empty() { key.to_string() } else { format!("{}.{key}", self.path) }
    }

    pub(super) fn only(&self, known: &[&str]) -> Result<(), Error> {
        match self.table.iter().find(|(key, _)| !known.contains(&key.get_ref().as_ref())) {
            None => Ok(()),
            Some((key, _)) => {
                let field = self.field(key.get_ref());
                Err(self.source.error(key.span().start, &field, format!("unknown; known here: {}", known.join(", "))))
            }
        }
    }

    pub(super) fn get(&self, key: &str) -> Option<&'a Spanned<DeValue<'a>>> {
        self.table.iter().find(|(found, _)| found.get_ref().as_ref() == key).map(|(_, value)| value)
    }

    pub(super) fn table(&self, key: &str) -> Result<Option<Table<'a>>, Error> {
        let Some(value) = self.get(key) else { return Ok(None) };
        let path = self.field(key);
        match value.get_ref() {
            DeValue::Table(table) => Ok(Some(Table { source: self.source, path, at: value.span().start, table })),
            other => Err(self.source.error(value.span().start, &path, format!("{} is no table", shown(other)))),
        }
    }

    pub(super) fn need_table(&self, key: &str) -> Result<Table<'a>, Error> {
        self.table(key)?.ok_or_else(|| self.missing(key))
    }

    fn missing(&self, key: &str) -> Error {
        self.source.error(self.at, &self.field(key), "missing".to_string())
    }

    pub(super) fn optional<T>(
        &self,
        key: &str,
        read: impl Fn(&'a Spanned<DeValue<'a>>, &At<'a>) -> Result<T, Error>,
    ) -> Result<Option<T>, Error> {
        let at = At { source: self.source, field: self.field(key) };
        self.get(key).map(|value| read(value, &at)).transpose()
    }

    pub(super) fn need<T>(
        &self,
        key: &str,
        read: impl Fn(&'a Spanned<DeValue<'a>>, &At<'a>) -> Result<T, Error>,
    ) -> Result<T, Error> {
        self.optional(key, read)?.ok_or_else(|| self.missing(key))
    }

    /// Complains at `key` if there is a flaw.
    pub(super) fn check(&self, key: &str, flaw: Option<String>) -> Result<(), Error> {
        let at = self.get(key).map_or(self.at, |value| value.span().start);
        flaw.map_or(Ok(()), |what| Err(self.source.error(at, &self.field(key), what)))
    }

    pub(super) fn texts(&self) -> Result<Vec<(String, String)>, Error> {
        Ok(self.table.iter().map(|(key, value)| (key.get_ref().to_string(), shown(value.get_ref()))).collect())
    }
}

impl<'a> At<'a> {
    pub(super) fn error(&self, value: &Spanned<DeValue<'_>>, what: String) -> Error {
        self.source.error(value.span().start, &self.field, what)
    }

    pub(super) fn number(&self, value: &Spanned<DeValue<'_>>) -> Result<f64, Error> {
        let text = shown(value.get_ref());
        let number = match value.get_ref() {
            DeValue::Float(_) | DeValue::Integer(_) => text.replace('_', "").parse::<f64>().ok(),
            _ => None,
        };
        match number {
            Some(number) if number.is_finite() => Ok(number),
            Some(_) => Err(self.error(value, format!("{text} is not finite"))),
            None => Err(self.error(value, format!("{text} is no number"))),
        }
    }

    pub(super) fn whole(&self, value: &Spanned<DeValue<'_>>, max: u32) -> Result<u32, Error> {
        let whole = match value.get_ref() {
            DeValue::Integer(integer) => i64::from_str_radix(&integer.as_str().replace('_', ""), integer.radix()).ok(),
            _ => None,
        };
        whole
            .and_then(|whole| u32::try_from(whole).ok())
            .filter(|whole| *whole <= max)
            .ok_or_else(|| self.error(value, format!("{} is no whole number in 0 ..= {max}", shown(value.get_ref()))))
    }

    /// One of a few words.
    pub(super) fn choice<T: Copy>(&self, value: &Spanned<DeValue<'_>>, words: &[(&str, T)]) -> Result<T, Error> {
        let known = |text: &str| words.iter().find(|(word, _)| text == *word).map(|(_, meant)| *meant);
        if let DeValue::String(text) = value.get_ref()
            && let Some(meant) = known(text)
        {
            return Ok(meant);
        }
        let words: Vec<String> = words.iter().map(|(word, _)| format!("{word:?}")).collect();
        let (none, and) = if words.len() == 2 { ("neither", "nor") } else { ("none of", "and") };
        let words =
            words.split_last().map_or(String::new(), |(last, rest)| format!("{} {and} {last}", rest.join(", ")));
        Err(self.error(value, format!("{} is {none} {words}", shown(value.get_ref()))))
    }

    pub(super) fn array<const N: usize>(
        &self,
        value: &'a Spanned<DeValue<'a>>,
    ) -> Result<[&'a Spanned<DeValue<'a>>; N], Error> {
        let DeValue::Array(array) = value.get_ref() else {
            return Err(self.error(value, format!("{} is no list of {N}", shown(value.get_ref()))));
        };
        let items: Vec<_> = array.iter().collect();
        let count = items.len();
        items.try_into().map_err(|_| self.error(value, format!("has {count} entries, not {N}")))
    }

    pub(super) fn vector(&self, value: &'a Spanned<DeValue<'a>>) -> Result<[f64; 3], Error> {
        let [x, y, z] = self.array::<3>(value)?;
        Ok([self.number(x)?, self.number(y)?, self.number(z)?])
    }
}

/// The value as a person wrote it, or nearly.
pub(super) fn shown(value: &DeValue<'_>) -> String {
    match value {
        DeValue::String(text) => format!("{text:?}"),
        DeValue::Integer(integer) => integer.as_str().to_string(),
        DeValue::Float(float) => float.as_str().to_string(),
        DeValue::Boolean(truth) => truth.to_string(),
        DeValue::Datetime(date) => date.to_string(),
        DeValue::Array(_) => "a list".to_string(),
        DeValue::Table(_) => "a table".to_string(),
    }
}
