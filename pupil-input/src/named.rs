//! Enums whose variants are counted, each under a name.

/// An enum of which each variant is written once, with its name.
///
/// `Wrapper(Enum),` before the variants takes in another such enum, whose places come first.
macro_rules! named {
    ($(#[$meta:meta])* pub enum $Enum:ident { $($(#[$doc:meta])* $Variant:ident = $name:literal,)+ }) => {
        $(#[$meta])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        pub enum $Enum { $($(#[$doc])* $Variant,)+ }

        impl $Enum {
            /// All of them, in the order of their indices.
            pub const ALL: [Self; [$($name),+].len()] = [$(Self::$Variant),+];

            /// Its place in [`Self::ALL`].
            pub const fn index(self) -> usize {
                self as usize
            }

            /// The name that stands for it wherever it is written.
            pub const fn name(self) -> &'static str {
                match self { $(Self::$Variant => $name),+ }
            }
        }
    };
    (
        $(#[$meta:meta])* pub enum $Enum:ident {
            $(#[$wrapper_doc:meta])* $Wrapper:ident($Inner:ident),
            $($(#[$doc:meta])* $Variant:ident = $name:literal,)+
        }
    ) => {
        $(#[$meta])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        pub enum $Enum { $(#[$wrapper_doc])* $Wrapper($Inner), $($(#[$doc])* $Variant,)+ }

        impl $Enum {
            /// The names under which they are counted, in the order of [`Self::index`].
            pub(crate) const NAMES: [&'static str; $Inner::ALL.len() + [$($name),+].len()] = {
                let mut names = [""; $Inner::ALL.len() + [$($name),+].len()];
                let mut index = 0;
                while index < $Inner::ALL.len() {
                    names[index] = $Inner::ALL[index].name();
                    index += 1;
                }
                $(names[Self::$Variant.index()] = $name;)+
                names
            };

            pub(crate) const fn index(self) -> usize {
                enum Own { $($Variant),+ }
                match self {
                    Self::$Wrapper(inner) => inner.index(),
                    $(Self::$Variant => $Inner::ALL.len() + Own::$Variant as usize),+
                }
            }
        }
    };
}

pub(crate) use named;
