"""Every SQL statement that makes or changes the shape of a case record, oldest first.

`MIGRATIONS[n]` brings a record from version n to n + 1; the version is SQLite's `user_version`.
Set-valued columns (setpoints, covariances, headers) are JSON text: read whole, never searched.
"""

MIGRATIONS: tuple[str, ...] = (
    """
    CREATE TABLE "case" (
        case_id     INTEGER PRIMARY KEY CHECK (case_id = 1),
        case_uid    TEXT NOT NULL,
        name        TEXT NOT NULL,
        seed        INTEGER NOT NULL,
        created_s   REAL NOT NULL
    ) STRICT;

    CREATE TABLE event (
        event_id      INTEGER PRIMARY KEY,
        wall_s        REAL NOT NULL,
        monotonic_s   REAL NOT NULL,
        source        TEXT NOT NULL,
        who           TEXT NOT NULL,
        kind          TEXT NOT NULL,
        body          TEXT NOT NULL,
        previous_hash TEXT NOT NULL,
        hash          TEXT NOT NULL UNIQUE
    ) STRICT;
    CREATE TRIGGER event_is_never_changed BEFORE UPDATE ON event
        BEGIN SELECT RAISE(ABORT, 'events are append-only'); END;
    CREATE TRIGGER event_is_never_removed BEFORE DELETE ON event
        BEGIN SELECT RAISE(ABORT, 'events are append-only'); END;

    CREATE TABLE hold (
        hold_id         INTEGER PRIMARY KEY,
        set_id          INTEGER NOT NULL,
        place           INTEGER NOT NULL,
        setpoints_um    TEXT NOT NULL,
        readback_um     TEXT NOT NULL,
        shift_um        TEXT NOT NULL,
        shift_px        TEXT NOT NULL,
        settled_at_s    REAL NOT NULL,
        ended_at_s      REAL,
        expected_slices INTEGER NOT NULL CHECK (expected_slices >= 0)
    ) STRICT;
    CREATE UNIQUE INDEX one_open_hold ON hold (ended_at_s IS NULL) WHERE ended_at_s IS NULL;

    CREATE TABLE slice (
        slice_id             INTEGER PRIMARY KEY,
        sop_instance_uid     TEXT NOT NULL,
        frame                INTEGER NOT NULL,
        sha256               TEXT NOT NULL,
        path                 TEXT NOT NULL,
        state                TEXT NOT NULL CHECK (state IN ('assigned', 'pending', 'quarantined')),
        hold_id              INTEGER REFERENCES hold (hold_id),
        reason_code          TEXT NOT NULL,
        reason               TEXT NOT NULL,
        received_s           REAL NOT NULL,
        received_monotonic_s REAL NOT NULL,
        acquired_from_s      REAL,
        acquired_to_s        REAL,
        time_source          TEXT NOT NULL,
        header               TEXT NOT NULL,
        decided_by           TEXT NOT NULL,
        UNIQUE (sop_instance_uid, frame, sha256),
        CHECK ((state = 'assigned') = (hold_id IS NOT NULL))
    ) STRICT;
    CREATE INDEX slice_by_hold ON slice (hold_id);
    CREATE INDEX slice_by_state ON slice (state);

    CREATE TABLE measurement (
        measurement_id INTEGER PRIMARY KEY,
        state          TEXT NOT NULL CHECK (state IN ('requested', 'done', 'failed')),
        method         TEXT NOT NULL,
        hold_ids       TEXT NOT NULL,
        request        TEXT NOT NULL,
        requested_s    REAL NOT NULL,
        finished_s     REAL,
        result         TEXT,
        reason_code    TEXT NOT NULL DEFAULT '',
        reason         TEXT NOT NULL DEFAULT ''
    ) STRICT;

    CREATE TABLE procedure (
        procedure_id INTEGER PRIMARY KEY,
        name         TEXT NOT NULL,
        arguments    TEXT NOT NULL,
        state        TEXT NOT NULL CHECK (state IN ('running', 'done', 'failed', 'aborted')),
        result       TEXT,
        started_s    REAL NOT NULL,
        ended_s      REAL
    ) STRICT;
    CREATE UNIQUE INDEX one_running_procedure ON procedure (state) WHERE state = 'running';

    CREATE TABLE step (
        procedure_id INTEGER NOT NULL REFERENCES procedure (procedure_id),
        number       INTEGER NOT NULL,
        kind         TEXT NOT NULL,
        body         TEXT NOT NULL,
        outcome      TEXT,
        sent_s       REAL NOT NULL,
        ended_s      REAL,
        PRIMARY KEY (procedure_id, number)
    ) STRICT;

    CREATE TABLE move (
        command_id     TEXT PRIMARY KEY,
        measurement_id INTEGER REFERENCES measurement (measurement_id),
        purpose        TEXT NOT NULL,
        setpoints_um   TEXT NOT NULL,
        state          TEXT NOT NULL,
        code           TEXT NOT NULL,
        text           TEXT NOT NULL,
        readback_um    TEXT NOT NULL,
        sent_s         REAL NOT NULL,
        ended_s        REAL
    ) STRICT;
    """,
    # What came before what: one number that grows with everything that happens, whoever writes it
    # and whatever the clocks say. What is older than this migration is ordered as its clock had it.
    """
    CREATE TABLE sequence (
        only_one INTEGER PRIMARY KEY CHECK (only_one = 1),
        last     INTEGER NOT NULL
    ) STRICT;
    INSERT INTO sequence
        SELECT 1, 1000 * (1 + COALESCE(MAX(event_id), 0)) FROM event;

    ALTER TABLE event ADD COLUMN seq INTEGER NOT NULL DEFAULT 0;
    ALTER TABLE hold ADD COLUMN begun_seq INTEGER NOT NULL DEFAULT 0;
    ALTER TABLE hold ADD COLUMN settled_monotonic_s REAL;
    ALTER TABLE hold ADD COLUMN bridge TEXT NOT NULL DEFAULT '{}';
    ALTER TABLE slice ADD COLUMN seq INTEGER NOT NULL DEFAULT 0;
    ALTER TABLE measurement ADD COLUMN requested_seq INTEGER NOT NULL DEFAULT 0;
    ALTER TABLE measurement ADD COLUMN finished_seq INTEGER NOT NULL DEFAULT 0;
    ALTER TABLE procedure ADD COLUMN begun_seq INTEGER NOT NULL DEFAULT 0;
    ALTER TABLE procedure ADD COLUMN ended_seq INTEGER NOT NULL DEFAULT 0;
    ALTER TABLE move ADD COLUMN sent_seq INTEGER NOT NULL DEFAULT 0;
    ALTER TABLE move ADD COLUMN ended_seq INTEGER NOT NULL DEFAULT 0;

    DROP TRIGGER event_is_never_changed;
    UPDATE event SET seq = 1000 * event_id;
    CREATE TRIGGER event_is_never_changed BEFORE UPDATE ON event
        BEGIN SELECT RAISE(ABORT, 'events are append-only'); END;
    UPDATE hold SET begun_seq = 1 + 1000 * COALESCE(
        (SELECT MAX(event_id) FROM event WHERE wall_s <= settled_at_s), 0);
    UPDATE slice SET seq = 1 + 1000 * COALESCE(
        (SELECT MAX(event_id) FROM event WHERE wall_s <= received_s), 0);
    UPDATE measurement SET requested_seq = 2 + 1000 * COALESCE(
        (SELECT MAX(event_id) FROM event WHERE wall_s <= requested_s), 0);
    UPDATE measurement SET finished_seq = 3 + 1000 * COALESCE(
        (SELECT MAX(event_id) FROM event WHERE wall_s <= finished_s), 0)
        WHERE finished_s IS NOT NULL;
    UPDATE procedure SET begun_seq = 1 + 1000 * COALESCE(
        (SELECT MAX(event_id) FROM event WHERE wall_s <= started_s), 0);
    UPDATE procedure SET ended_seq = 4 + 1000 * COALESCE(
        (SELECT MAX(event_id) FROM event WHERE wall_s <= ended_s), 0)
        WHERE ended_s IS NOT NULL;
    UPDATE move SET sent_seq = 2 + 1000 * COALESCE(
        (SELECT MAX(event_id) FROM event WHERE wall_s <= sent_s), 0);
    UPDATE move SET ended_seq = 3 + 1000 * COALESCE(
        (SELECT MAX(event_id) FROM event WHERE wall_s <= ended_s), 0)
        WHERE ended_s IS NOT NULL;
    CREATE INDEX slice_by_seq ON slice (seq);
    CREATE INDEX event_by_kind ON event (kind, event_id);
    """,
    # One chain of hashes over all rows (`seal_chain`); no query without an index.
    """
    CREATE TABLE seal (
        seal_id INTEGER PRIMARY KEY,
        tbl     TEXT NOT NULL,
        row     INTEGER NOT NULL,
        digest  BLOB NOT NULL,
        hash    BLOB NOT NULL
    ) STRICT;
    CREATE INDEX seal_by_row ON seal (tbl, row, seal_id);
    CREATE TRIGGER seal_is_never_changed BEFORE UPDATE ON seal
        BEGIN SELECT RAISE(ABORT, 'seals are append-only'); END;
    CREATE INDEX measurement_by_state ON measurement (state, measurement_id);
    CREATE INDEX procedure_by_name ON procedure (name, state, procedure_id);
    CREATE INDEX hold_by_set ON hold (set_id);
    CREATE INDEX slice_by_sha256 ON slice (sha256);
    """,
)

SCHEMA_VERSION = len(MIGRATIONS)
