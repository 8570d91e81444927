//! A pickle interpreter that cannot execute anything.
//!
//! A pickle is a program for a small stack machine whose instructions may name any Python function and call it. This
//! one knows the handful of constructors that state dicts are made of and refuses every other name, so that reading a
//! checkpoint is as harmless as reading a picture. Everything it builds lives in one arena: a program that refers to an
//! object a million times makes a million indices, not a million copies.

use std::{collections::HashMap, sync::Arc};

use candle_core::DType;

/// Why a pickle was refused; the caller adds the path.
pub(super) type Result<T> = std::result::Result<T, String>;

/// Index of an object in a [`Pickle`]'s arena.
pub(super) type Handle = usize;

const MAX_OBJECTS: usize = 4 << 20;
const MAX_STACK: usize = 1 << 20;
const MAX_TEXT_BYTES: usize = 1 << 20;
const MAX_DIMENSIONS: usize = 16;

/// What a dict is indexed by.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub enum Key {
    /// A name.
    Text(Arc<str>),
    /// A number, as optimisers' states use.
    Integer(i64),
}

impl std::fmt::Display for Key {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Text(text) => f.write_str(text),
            Self::Integer(number) => write!(f, "{number}"),
        }
    }
}

/// A dict in insertion order, in which a key set again keeps its place, as in Python.
#[derive(Debug, Default)]
pub(super) struct Dict {
    pub entries: Vec<(Key, Handle)>,
    places: HashMap<Key, usize>,
}

impl Dict {
    fn set(&mut self, key: Key, value: Handle) {
        if let Some(entry) = self.places.get(&key).and_then(|&place| self.entries.get_mut(place)) {
            entry.1 = value;
        } else {
            self.places.insert(key.clone(), self.entries.len());
            self.entries.push((key, value));
        }
    }
}

/// A run of numbers in the archive, named by its key.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct StorageReference {
    pub key: Arc<str>,
    pub dtype: DType,
    pub elements: usize,
}

/// A tensor as a view of a storage; offset and strides in elements.
#[derive(Clone, Debug)]
pub(super) struct TensorView {
    pub storage: StorageReference,
    pub offset: usize,
    pub shape: Vec<usize>,
    pub strides: Vec<usize>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Constructor {
    OrderedDict,
    RebuildTensor,
    RebuildParameter,
    Storage(DType),
}

#[derive(Debug)]
pub(super) enum Object {
    None,
    Bool(bool),
    Integer(i64),
    Float(f64),
    Text(Arc<str>),
    List(Vec<Handle>),
    Tuple(Vec<Handle>),
    Dict(Dict),
    Constructor(Constructor),
    Storage(StorageReference),
    Tensor(Box<TensorView>),
}

/// The objects a pickle describes, and which of them is the whole.
#[derive(Debug)]
pub(super) struct Pickle {
    pub objects: Vec<Object>,
    pub root: Handle,
}

/// Runs the program.
pub(super) fn interpret(program: &[u8]) -> Result<Pickle> {
    let mut machine = Machine { input: program, ..Machine::default() };
    while !machine.step()? {}
    let root = machine.pop()?;
    Ok(Pickle { objects: machine.objects, root })
}

fn constructor(module: &str, name: &str) -> Result<Constructor> {
    Ok(match (module, name) {
        ("collections", "OrderedDict") => Constructor::OrderedDict,
        ("torch._utils", "_rebuild_tensor_v2") => Constructor::RebuildTensor,
        ("torch._utils", "_rebuild_parameter") => Constructor::RebuildParameter,
        ("torch", "DoubleStorage") => Constructor::Storage(DType::F64),
        ("torch", "FloatStorage") => Constructor::Storage(DType::F32),
        ("torch", "HalfStorage") => Constructor::Storage(DType::F16),
        ("torch", "BFloat16Storage") => Constructor::Storage(DType::BF16),
        ("torch", "LongStorage") => Constructor::Storage(DType::I64),
        ("torch", "IntStorage") => Constructor::Storage(DType::I32),
        ("torch", "ShortStorage") => Constructor::Storage(DType::I16),
        ("torch", "ByteStorage" | "BoolStorage") => Constructor::Storage(DType::U8),
        _ => {
            return Err(format!(
                "names `{}`, which is not one of the few constructors that are allowed (nothing in the file was \
                 executed); save its state dicts alone: torch.save({{name: module.state_dict()}}, path)",
                printable(&format!("{module}.{name}"))
            ));
        }
    })
}

/// `text` on one line, without control characters, at most 80 characters long.
fn printable(text: &str) -> String {
    text.chars().take(80).map(|c| if c.is_control() { '?' } else { c }).collect()
}

#[derive(Default)]
struct Machine<'a> {
    input: &'a [u8],
    objects: Vec<Object>,
    stack: Vec<Handle>,
    /// Heights of the stack at the open marks; nothing below the last one may be popped.
    marks: Vec<usize>,
    memo: HashMap<u32, Handle>,
}

impl Machine<'_> {
    /// Executes one instruction; true at the end of the program.
    fn step(&mut self) -> Result<bool> {
        let [opcode] = self.take()?;
        match opcode {
            b'.' => return Ok(true),
            // PROTO and FRAME say nothing that is needed.
            0x80 => self.take::<1>().map(drop)?,
            0x95 => self.take::<8>().map(drop)?,
            b'c' => {
                let (module, name) = (self.line()?, self.line()?);
                let named = constructor(&module, &name)?;
                self.create(Object::Constructor(named))?;
            }
            0x93 => {
                let (name, module) = (self.pop_text()?, self.pop_text()?);
                let named = constructor(&module, &name)?;
                self.create(Object::Constructor(named))?;
            }
            b'(' => {
                if self.marks.len() >= MAX_STACK {
                    return Err("opens too many marks; the file is damaged".into());
                }
                self.marks.push(self.stack.len());
            }
            b'N' => self.create(Object::None)?,
            0x88 => self.create(Object::Bool(true))?,
            0x89 => self.create(Object::Bool(false))?,
            b'K' => self.integer::<1>()?,
            b'M' => self.integer::<2>()?,
            b'J' => {
                let value = i32::from_le_bytes(self.take()?);
                self.create(Object::Integer(value.into()))?;
            }
            0x8a => self.long()?,
            b'G' => {
                let value = f64::from_be_bytes(self.take()?);
                self.create(Object::Float(value))?;
            }
            b'X' => {
                let length = u32::from_le_bytes(self.take()?) as usize;
                self.text(length)?;
            }
            0x8c => {
                let [length] = self.take()?;
                self.text(length.into())?;
            }
            b'q' => {
                let [index] = self.take()?;
                self.memoize(index.into())?;
            }
            b'r' => {
                let index = u32::from_le_bytes(self.take()?);
                self.memoize(index)?;
            }
            0x94 => self.memoize(self.memo.len() as u32)?,
            b'h' => {
                let [index] = self.take()?;
                self.recall(index.into())?;
            }
            b'j' => {
                let index = u32::from_le_bytes(self.take()?);
                self.recall(index)?;
            }
            b')' => self.create(Object::Tuple(Vec::new()))?,
            0x85..=0x87 => self.short_tuple(opcode - 0x84)?,
            b't' => {
                let items = self.pop_to_mark()?;
                self.create(Object::Tuple(items))?;
            }
            b']' => self.create(Object::List(Vec::new()))?,
            b'a' => {
                let item = self.pop()?;
                self.extend_list(vec![item])?;
            }
            b'e' => {
                let items = self.pop_to_mark()?;
                self.extend_list(items)?;
            }
            b'}' => self.create(Object::Dict(Dict::default()))?,
            b's' => {
                let (value, key) = (self.pop()?, self.pop()?);
                self.extend_dict(&[key, value])?;
            }
            b'u' => {
                let items = self.pop_to_mark()?;
                self.extend_dict(&items)?;
            }
            b'Q' => self.persistent()?,
            b'R' => self.reduce()?,
            b'b' => self.build()?,
            other => return Err(format!("uses pickle instruction 0x{other:02x}, which no state dict needs")),
        }
        Ok(false)
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N]> {
        let (taken, rest) = self.input.split_first_chunk::<N>().ok_or("its pickle is cut short; download it again")?;
        self.input = rest;
        Ok(*taken)
    }

    fn line(&mut self) -> Result<String> {
        let end = self.input.iter().take(1024).position(|&byte| byte == b'\n').ok_or("a name in it does not end")?;
        let (line, rest) = self.input.split_at(end);
        self.input = rest.get(1..).unwrap_or_default();
        Ok(String::from_utf8_lossy(line).into_owned())
    }

    fn create(&mut self, object: Object) -> Result<()> {
        if self.objects.len() >= MAX_OBJECTS {
            return Err(format!("holds more than {MAX_OBJECTS} objects; no generator's checkpoint does"));
        }
        self.objects.push(object);
        self.push(self.objects.len() - 1)
    }

    fn push(&mut self, handle: Handle) -> Result<()> {
        if self.stack.len() >= MAX_STACK {
            return Err("nests or lists too many values at once; the file is damaged".into());
        }
        self.stack.push(handle);
        Ok(())
    }

    fn pop(&mut self) -> Result<Handle> {
        let floor = self.marks.last().copied().unwrap_or(0);
        if self.stack.len() <= floor {
            return Err("its pickle takes a value that is not there; the file is damaged".into());
        }
        self.stack.pop().ok_or_else(|| "its pickle takes a value that is not there; the file is damaged".into())
    }

    fn pop_to_mark(&mut self) -> Result<Vec<Handle>> {
        let height = self.marks.pop().ok_or("its pickle closes a mark it has not opened; the file is damaged")?;
        Ok(self.stack.split_off(height.min(self.stack.len())))
    }

    /// The object on top of the stack, left there.
    fn top(&mut self) -> Result<&mut Object> {
        let handle = self.pop()?;
        self.stack.push(handle);
        self.objects.get_mut(handle).ok_or_else(|| "its pickle names an object that is not there".into())
    }

    fn object(&self, handle: Handle) -> Result<&Object> {
        self.objects.get(handle).ok_or_else(|| "its pickle names an object that is not there".into())
    }

    fn pop_text(&mut self) -> Result<Arc<str>> {
        let handle = self.pop()?;
        match self.object(handle)? {
            Object::Text(text) => Ok(Arc::clone(text)),
            other => Err(unexpected("text", other)),
        }
    }

    fn integer<const N: usize>(&mut self) -> Result<()> {
        let bytes = self.take::<N>()?;
        let value = bytes.iter().rev().fold(0i64, |value, &byte| (value << 8) | i64::from(byte));
        self.create(Object::Integer(value))
    }

    /// LONG1: a little-endian two's complement number of up to 255 bytes, of which 8 are enough for us.
    fn long(&mut self) -> Result<()> {
        let [length] = self.take()?;
        let mut value = 0i64;
        let mut last = 0u8;
        if length > 8 {
            return Err("holds an integer of more than 64 bits".into());
        }
        for index in 0..length {
            [last] = self.take()?;
            value |= i64::from(last) << (8 * u32::from(index));
        }
        if last & 0x80 != 0 && length < 8 {
            value -= 1i64 << (8 * u32::from(length));
        }
        self.create(Object::Integer(value))
    }

    fn text(&mut self, length: usize) -> Result<()> {
        if length > MAX_TEXT_BYTES {
            return Err(format!("holds a text of more than {MAX_TEXT_BYTES} bytes"));
        }
        let (bytes, rest) = self.input.split_at_checked(length).ok_or("its pickle is cut short; download it again")?;
        self.input = rest;
        let text = std::str::from_utf8(bytes).map_err(|_| "holds a text that is not UTF-8")?;
        self.create(Object::Text(text.into()))
    }

    fn memoize(&mut self, index: u32) -> Result<()> {
        let handle = self.pop()?;
        self.stack.push(handle);
        if self.memo.len() >= MAX_OBJECTS {
            return Err("remembers too many objects; the file is damaged".into());
        }
        self.memo.insert(index, handle);
        Ok(())
    }

    fn recall(&mut self, index: u32) -> Result<()> {
        let handle = *self.memo.get(&index).ok_or("its pickle recalls an object it never kept; the file is damaged")?;
        self.push(handle)
    }

    fn short_tuple(&mut self, length: u8) -> Result<()> {
        let mut items = (0..length).map(|_| self.pop()).collect::<Result<Vec<_>>>()?;
        items.reverse();
        self.create(Object::Tuple(items))
    }

    fn extend_list(&mut self, items: Vec<Handle>) -> Result<()> {
        match self.top()? {
            Object::List(list) => list.extend(items),
            other => return Err(unexpected("a list", other)),
        }
        Ok(())
    }

    fn extend_dict(&mut self, items: &[Handle]) -> Result<()> {
        let (pairs, rest) = items.as_chunks::<2>();
        if !rest.is_empty() {
            return Err("a dict in it has a key without a value; the file is damaged".into());
        }
        let entries =
            pairs.iter().map(|&[key, value]| Ok((self.key(key)?, value))).collect::<Result<Vec<(Key, Handle)>>>()?;
        match self.top()? {
            Object::Dict(dict) => entries.into_iter().for_each(|(key, value)| dict.set(key, value)),
            other => return Err(unexpected("a dict", other)),
        }
        Ok(())
    }

    fn key(&self, handle: Handle) -> Result<Key> {
        match self.object(handle)? {
            Object::Text(text) => Ok(Key::Text(Arc::clone(text))),
            Object::Integer(number) => Ok(Key::Integer(*number)),
            other => Err(unexpected("a dict's key as text or an integer", other)),
        }
    }

    /// BINPERSID: ('storage', class, key, location, number of elements) names a storage of the archive.
    fn persistent(&mut self) -> Result<()> {
        let handle = self.pop()?;
        let Object::Tuple(items) = self.object(handle)? else {
            return Err(unexpected("a storage's description", self.object(handle)?));
        };
        let &[kind, class, key, _location, elements] = items.as_slice() else {
            return Err("describes a storage in a way that PyTorch does not; the file is damaged".into());
        };
        let storage = match (self.object(kind)?, self.object(class)?, self.object(key)?, self.object(elements)?) {
            (
                Object::Text(kind),
                Object::Constructor(Constructor::Storage(dtype)),
                Object::Text(key),
                Object::Integer(elements),
            ) if &**kind == "storage" => {
                StorageReference { key: Arc::clone(key), dtype: *dtype, elements: size(*elements)? }
            }
            _ => return Err("describes a storage in a way that PyTorch does not; the file is damaged".into()),
        };
        self.create(Object::Storage(storage))
    }

    fn reduce(&mut self) -> Result<()> {
        let (arguments, callable) = (self.pop()?, self.pop()?);
        let callable = match self.object(callable)? {
            Object::Constructor(constructor) => *constructor,
            other => return Err(unexpected("a constructor", other)),
        };
        let Object::Tuple(arguments) = self.object(arguments)? else {
            return Err(unexpected("a constructor's arguments", self.object(arguments)?));
        };
        match callable {
            Constructor::OrderedDict => {
                let dict = match arguments.as_slice() {
                    [] => Dict::default(),
                    [pairs] => self.dict_of_pairs(*pairs)?,
                    _ => return Err("makes an OrderedDict of more than one argument".into()),
                };
                self.create(Object::Dict(dict))
            }
            Constructor::RebuildTensor => {
                let view = self.tensor(arguments)?;
                self.create(Object::Tensor(Box::new(view)))
            }
            Constructor::RebuildParameter => match arguments.first().copied() {
                Some(data) if matches!(self.object(data)?, Object::Tensor(_)) => self.push(data),
                _ => Err("makes a parameter of something that is not a tensor".into()),
            },
            Constructor::Storage(_) => Err("makes a storage outside the archive; save it again with torch.save".into()),
        }
    }

    fn dict_of_pairs(&self, pairs: Handle) -> Result<Dict> {
        let Object::List(pairs) = self.object(pairs)? else {
            return Err(unexpected("an OrderedDict's list of pairs", self.object(pairs)?));
        };
        let mut dict = Dict::default();
        for &pair in pairs {
            let (Object::List(items) | Object::Tuple(items)) = self.object(pair)? else {
                return Err(unexpected("an OrderedDict's pair", self.object(pair)?));
            };
            let &[key, value] = items.as_slice() else {
                return Err("an OrderedDict in it has a pair that is not one; the file is damaged".into());
            };
            dict.set(self.key(key)?, value);
        }
        Ok(dict)
    }

    /// Arguments: storage, offset, shape, strides, requires_grad, backward hooks and perhaps metadata.
    fn tensor(&self, arguments: &[Handle]) -> Result<TensorView> {
        let &[storage, offset, shape, strides, ..] = arguments else {
            return Err("makes a tensor of too few arguments; the file is damaged".into());
        };
        let (Object::Storage(storage), Object::Integer(offset)) = (self.object(storage)?, self.object(offset)?) else {
            return Err("makes a tensor without a storage; the file is damaged".into());
        };
        let (shape, strides) = (self.sizes(shape)?, self.sizes(strides)?);
        if shape.len() != strides.len() || shape.len() > MAX_DIMENSIONS {
            return Err(format!("holds a tensor of shape {shape:?} with strides {strides:?}; the file is damaged"));
        }
        Ok(TensorView { storage: storage.clone(), offset: size(*offset)?, shape, strides })
    }

    fn sizes(&self, handle: Handle) -> Result<Vec<usize>> {
        match self.object(handle)? {
            Object::Tuple(items) => items
                .iter()
                .take(MAX_DIMENSIONS + 1)
                .map(|&item| match self.object(item)? {
                    Object::Integer(value) => size(*value),
                    other => Err(unexpected("a tensor's size", other)),
                })
                .collect(),
            other => Err(unexpected("a tensor's sizes", other)),
        }
    }

    /// BUILD sets attributes; a state dict's are `_metadata` (module versions), which nothing here reads.
    fn build(&mut self) -> Result<()> {
        self.pop()?;
        match self.top()? {
            Object::Dict(_) => Ok(()),
            other => Err(unexpected("a dict to set attributes of", other)),
        }
    }
}

fn size(value: i64) -> Result<usize> {
    usize::try_from(value).map_err(|_| format!("holds the impossible size {value}; the file is damaged"))
}

fn unexpected(expected: &str, found: &Object) -> String {
    let found = match found {
        Object::None => "None",
        Object::Bool(_) => "a truth value",
        Object::Integer(_) => "an integer",
        Object::Float(_) => "a float",
        Object::Text(_) => "text",
        Object::List(_) => "a list",
        Object::Tuple(_) => "a tuple",
        Object::Dict(_) => "a dict",
        Object::Constructor(_) => "a constructor",
        Object::Storage(_) => "a storage",
        Object::Tensor(_) => "a tensor",
    };
    format!("has {found} where {expected} should be; it is damaged, or not a checkpoint of state dicts")
}
