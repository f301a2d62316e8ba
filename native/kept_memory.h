// Memory that a process has freed, kept for what asks next.
#pragma once

namespace evsplat {

// Lets the C library keep up to 512 MB that were freed, in pages of 2 MB where the system has them; false where
// it is not glibc, whose settings these are. Holds for the whole process; asked for again, it does nothing.
bool keep_freed_memory();

}  // namespace evsplat
