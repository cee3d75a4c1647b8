/* The functions by which a simulator keeps the state of a block, brings it back and stores it, with
 * the names of either version. The state is one struct without pointers. */
#define STATE_FUNCTIONS(Get, Set, Free, Size, Serialize, Deserialize, Byte)                        \
    BLOCK_EXPORT Status Get(Component c, State *state)                                             \
    {                                                                                              \
        *state = *state ? *state : malloc(sizeof(block));                                          \
        if (!*state) {                                                                             \
            return wrong(c, #Get ": out of memory");                                               \
        }                                                                                          \
        memcpy(*state, &((Instance *) c)->block, sizeof(block));                                   \
        return OK;                                                                                 \
    }                                                                                              \
                                                                                                   \
    BLOCK_EXPORT Status Set(Component c, State state)                                              \
    {                                                                                              \
        memcpy(&((Instance *) c)->block, state, sizeof(block));                                    \
        return OK;                                                                                 \
    }                                                                                              \
                                                                                                   \
    BLOCK_EXPORT Status Free(Component c, State *state)                                            \
    {                                                                                              \
        (void) c;                                                                                  \
        free(*state);                                                                              \
        *state = NULL;                                                                             \
        return OK;                                                                                 \
    }                                                                                              \
                                                                                                   \
    BLOCK_EXPORT Status Size(Component c, State state, size_t *size)                               \
    {                                                                                              \
        (void) c, (void) state;                                                                    \
        *size = sizeof(block);                                                                     \
        return OK;                                                                                 \
    }                                                                                              \
                                                                                                   \
    BLOCK_EXPORT Status Serialize(Component c, State state, Byte bytes[], size_t size)             \
    {                                                                                              \
        if (size < sizeof(block)) {                                                                \
            return wrong(c, #Serialize ": too little room");                                       \
        }                                                                                          \
        memcpy(bytes, state, sizeof(block));                                                       \
        return OK;                                                                                 \
    }                                                                                              \
                                                                                                   \
    BLOCK_EXPORT Status Deserialize(Component c, const Byte bytes[], size_t size, State *state)    \
    {                                                                                              \
        *state = size == sizeof(block) ? malloc(size) : NULL;                                      \
        if (!*state) {                                                                             \
            return wrong(c, #Deserialize ": these bytes are no state of this FMU");                \
        }                                                                                          \
        memcpy(*state, bytes, size);                                                               \
        return OK;                                                                                 \
    }
