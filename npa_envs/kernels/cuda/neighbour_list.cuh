// For cuda/density.py and cuda/perceive.py: neighbour lists, made in shared memory, and read.

namespace npa {

// A thread has a column of 32-bit words, a block's width apart, with two entries each, so that no two
// threads of a warp use the same bank. ROOM: entries of a list; there is further room for the MANY
// candidates of one round, after which the list is cut off.
template <int ROOM, int MANY, int BLOCK> __device__ inline unsigned list_address()
{
    __shared__ ushort2 lists[(ROOM / 2 + 1 + MANY) * BLOCK];
    return (unsigned)__cvta_generic_to_shared(lists + threadIdx.x);
}

// Address of the next entry, and the distance [bytes] from it to the one after.
using ListEnd = wp::vec_t<2, unsigned>;

template <int BLOCK> __device__ inline ListEnd list_end_of(unsigned address, int entries)
{
    return ListEnd(address + 4 * BLOCK * (entries / 2), 2);
}

// In assembly, without branches and so that the compiler may move global loads ahead of it.
template <int BLOCK>
__device__ inline ListEnd append_step(ListEnd end, float weight, int step)
{
    asm volatile(
        "{ .reg .pred near;\n"
        "setp.gt.f32 near, %2, 0f00000000;\n"
        "@near st.shared.u16 [%0], %3;\n"
        "@near add.u32 %0, %0, %1;\n"
        "@near sub.u32 %1, %4, %1; }"
        : "+r"(end.c[0]), "+r"(end.c[1])
        : "f"(weight), "h"((short)step), "n"(4 * BLOCK));
    return end;
}

// Set the end of a list that is too long to just beyond its room.
template <int ROOM, int BLOCK> __device__ inline ListEnd cut_off(unsigned address, ListEnd end)
{
    end.c[0] = min(end.c[0], address + 4 * BLOCK * (ROOM / 2 + 1));
    return end;
}

// Index at which a row's list begins: lists of 32 rows are interleaved, two entries at a time. (Those
// of `density.cuh` are stored one after the other.)
template <int CAPACITY> __device__ inline size_t place_of_list(int row)
{
    return (size_t)(row / 32) * (32 * CAPACITY) + row % 32 * 2;
}

__device__ inline int place_of_entry(int entry) { return entry / 2 * 64 + entry % 2; }

// Write a row's list, each lane's entries after those of the lanes before it; return its length.
template <int ROOM, int BLOCK, int CAPACITY, int LANES>
__device__ inline int leave_list(
    unsigned address, ListEnd list_end, int row, const wp::array_t<wp::int16>& lists)
{
    const unsigned bytes = list_end.c[0] - address;
    int length = bytes / (4 * BLOCK) * 2 + bytes / 2 % 2;
    if (length > ROOM) length = CAPACITY + 1;
    const int end = sum_up_to<LANES>(length);
    const int total = LANES > 1 ? __shfl_sync(~0u, end, LANES - 1, LANES) : length;
    if (row < 0 || total > CAPACITY) return total;
    short* to = lists.data + place_of_list<CAPACITY>(row);
    if (LANES == 1) {
        // If their number is odd, with one more entry, which is not read.
        for (int pair = 0; pair < (length + 1) / 2; ++pair) {
            int steps;
            asm volatile("ld.shared.u32 %0, [%1];" : "=r"(steps) : "r"(address + 4 * BLOCK * pair));
            *reinterpret_cast<int*>(to + 64 * pair) = steps;
        }
        return total;
    }
    for (int entry = 0; entry < length; ++entry) {
        short step;
        const unsigned from = address + 4 * BLOCK * (entry / 2) + 2 * (entry % 2);
        asm volatile("ld.shared.u16 %0, [%1];" : "=h"(step) : "r"(from));
        to[place_of_entry(end - length + entry)] = step;
    }
    return total;
}

// Entries 2 number and 2 number + 1 of a row's list, packed in 32 bits; beyond the capacity, those of
// another pair. TILED: lists are stored one after the other.
template <int CAPACITY, bool TILED>
__device__ inline int pair_at(const wp::array_t<wp::int16>& lists, int row, int number)
{
    const int known = min(number, CAPACITY / 2 - 1);
    const short* from = TILED ? lists.data + (size_t)row * CAPACITY + 2 * known
                              : lists.data + place_of_list<CAPACITY>(row) + 64 * known;
    return *reinterpret_cast<const int*>(from);
}

// Entry 0 or 1 of two packed entries.
__device__ inline int entry_of(int pair, int number) { return (short)(pair >> 16 * number); }

}  // namespace npa
