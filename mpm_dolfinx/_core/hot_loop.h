// Copyright (C) 2026 the mpm-dolfinx authors
// SPDX-License-Identifier: LGPL-3.0-or-later

#pragma once

// A loop that is compiled for processors with and without AVX2; the loader picks one.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define HOT_LOOP __attribute__((target_clones("arch=haswell", "default"), flatten))
#else
#define HOT_LOOP
#endif
