-- Frames of lighthouse motes in Wireshark: fixes, health and angles, fields by name and in SI units.
--
-- Put this file into Wireshark's folder of personal Lua plugins (Help, About, Folders), or name it on the command line:
--     tshark -X lua_script:wireshark/lighthouse-mote.lua -r target/run/frames.pcap
--
-- The frames are those of src/frame.rs, src/frame/health.rs and src/frame/angles.rs; xtask/tests/dissector.rs holds the
-- two against each other. What can go wrong: bytes that are not ours go back to Wireshark; a length, version or kind
-- that is unknown, or a mote id that is not the source address, is marked by an expert note.

local lighthouse = Proto("lighthouse", "Lighthouse mote")

local KINDS = { [1] = "fix", [2] = "health", [3] = "angles" }
local LEVELS = { [0] = "none", [1] = "angles", [2] = "tracked", [3] = "full" }
local LOCKS = {
    [0] = "no light", [1] = "searching", [2] = "locked", [3] = "one station, unnamed", [4] = "spacing of the flashes",
    [5] = "widths of the flashes", [6] = "Lighthouse V2",
}
local RESETS = { [0] = "power on", [1] = "requested", [2] = "fault", [3] = "panic", [4] = "watchdog", [5] = "damaged image" }
local MODES = { [0] = "A", [1] = "B", [2] = "C" }
local FACTORIES = { [0] = "of the file", [1] = "awaited", [2] = "received" }
local ROTORS = { [0] = "A azimuth", [1] = "B azimuth", [2] = "A elevation", [3] = "B elevation" }

local VERSION = 1
-- Offsets within the payload, which begins 9 bytes into a plain frame.
local ENVELOPE, FIX, HEALTH, ANGLES_BEFORE, ANGLE, ANGLES_MOST = 8, 55, 81, 12, 8, 8

local f = {}
local function field(name, make, text, ...)
    f[name] = make("lighthouse." .. name, text, ...)
end

field("magic", ProtoField.string, "Magic")
field("version", ProtoField.uint8, "Version")
field("kind", ProtoField.uint8, "Kind", base.DEC, KINDS)
field("mote", ProtoField.uint16, "Mote", base.HEX)
field("sequence", ProtoField.uint16, "Sequence")

field("time", ProtoField.uint32, "Time of the fix (ticks)")
field("half_turn", ProtoField.double, "Half turn (ticks, 8.333 ms)")
field("clock", ProtoField.double, "Clock of the mote (Hz)")
field("x", ProtoField.double, "x (m)")
field("y", ProtoField.double, "y (m)")
field("z", ProtoField.double, "z (m)")
field("mismatch", ProtoField.double, "Epipolar mismatch (m)")
field("age", ProtoField.double, "Age of the oldest angle (half turns)")
field("station_a", ProtoField.bool, "Station A gave an angle lately", 8, nil, 0x01)
field("station_b", ProtoField.bool, "Station B gave an angle lately", 8, nil, 0x02)
field("level", ProtoField.uint8, "Level", base.DEC, LEVELS, 0x30)
field("vx", ProtoField.double, "Velocity x (m/s)")
field("vy", ProtoField.double, "Velocity y (m/s)")
field("vz", ProtoField.double, "Velocity z (m/s)")
field("sd_x", ProtoField.double, "Standard deviation x (m)")
field("sd_y", ProtoField.double, "Standard deviation y (m)")
field("sd_z", ProtoField.double, "Standard deviation z (m)")
field("lost_edges", ProtoField.uint16, "Edges lost")
field("lost_pulses", ProtoField.uint16, "Pulses that fit no window")
field("lost_sweeps", ProtoField.uint16, "Sweeps out of view or lost")
field("lost_fixes", ProtoField.uint16, "Fixes and sweeps refused")
field("lost_reports", ProtoField.uint16, "Reports lost")

field("uptime", ProtoField.uint32, "Uptime (s)")
field("lock", ProtoField.uint8, "Lock", base.DEC, LOCKS)
field("reset", ProtoField.uint8, "Last reset", base.DEC, RESETS)
field("reset_detail", ProtoField.uint32, "Program counter of the fault, line of the panic", base.HEX_DEC)
field("syncs_a", ProtoField.uint16, "Flashes of A")
field("syncs_b", ProtoField.uint16, "Flashes of B")
field("sweeps_a_az", ProtoField.uint16, "Sweeps of A, azimuth")
field("sweeps_a_el", ProtoField.uint16, "Sweeps of A, elevation")
field("sweeps_b_az", ProtoField.uint16, "Sweeps of B, azimuth")
field("sweeps_b_el", ProtoField.uint16, "Sweeps of B, elevation")
local REJECTS = {
    { "edges", "edges" }, { "strays", "pulses in no window" }, { "widths", "flashes of no width" },
    { "short", "pulses too short" }, { "long", "pulses too long" }, { "second", "second sweeps of a slot" },
    { "outside", "sweeps out of view" }, { "geometry", "fixes for geometry" }, { "mismatch", "fixes for mismatch" },
    { "disbelieved", "sweeps disbelieved" }, { "reports", "reports" }, { "locks", "times the cycle was lost" },
}
for _, reject in ipairs(REJECTS) do
    field("rejects_" .. reject[1], ProtoField.uint16, "Rejected: " .. reject[2])
end
field("waiting_pulses", ProtoField.uint8, "Most pulses that waited")
field("waiting_sightings", ProtoField.uint8, "Most sightings that waited")
field("waiting_reports", ProtoField.uint8, "Most reports that waited")
for _, name in ipairs({ "a", "b" }) do
    local of = " of " .. name:upper()
    field(name .. "_id", ProtoField.uint32, "Serial number" .. of, base.HEX)
    field(name .. "_good", ProtoField.uint8, "Good OOTX frames" .. of)
    field(name .. "_bad", ProtoField.uint8, "Dropped OOTX frames" .. of)
    field(name .. "_mode", ProtoField.uint8, "Mode" .. of, base.DEC, MODES)
    field(name .. "_faults", ProtoField.uint8, "Faults" .. of, base.HEX)
    field(name .. "_width_bias", ProtoField.double, "Width bias" .. of .. " (us)")
    field(name .. "_factory", ProtoField.uint8, "Factory terms" .. of, base.DEC, FACTORIES, 0x03)
    field(name .. "_is_stranger", ProtoField.bool, "Another station than the room's file says:" .. of, 8, nil, 0x04)
end

field("sweep", ProtoField.none, "Sweep")
field("sweep_time", ProtoField.uint32, "Time of the laser (ticks)")
field("sweep_rotor", ProtoField.uint8, "Rotor", base.DEC, ROTORS)
field("sweep_share", ProtoField.double, "Time since the flash (half turns)")
field("sweep_angle", ProtoField.double, "Angle as measured (degrees)")

lighthouse.fields = f

local e_version = ProtoExpert.new("lighthouse.unknown_version", "Unknown version", expert.group.PROTOCOL,
    expert.severity.WARN)
local e_kind = ProtoExpert.new("lighthouse.unknown_kind", "Unknown kind", expert.group.PROTOCOL, expert.severity.WARN)
local e_length = ProtoExpert.new("lighthouse.bad_length", "Not the length of its kind", expert.group.MALFORMED,
    expert.severity.ERROR)
local e_mote = ProtoExpert.new("lighthouse.bad_mote", "Not the source address", expert.group.PROTOCOL,
    expert.severity.WARN)
lighthouse.experts = { e_version, e_kind, e_length, e_mote }

local source = Field.new("wpan.src16")

-- A reader that walks through the payload.
local function walker(buffer, at)
    local walk = {}
    function walk.take(count)
        local range = buffer(at, count)
        at = at + count
        return range
    end
    function walk.whole(tree, name, count)
        local range = walk.take(count)
        tree:add_le(f[name], range)
        return range:le_uint()
    end
    function walk.fraction(tree, name, count, unit, signed)
        local range = walk.take(count)
        local value = (signed and range:le_int() or range:le_uint()) * unit
        tree:add(f[name], range, value)
        return value
    end
    return walk
end

-- The half turn, and the clock that it means: 120 half turns in a second.
local function half_turn(walk, tree)
    local range = walk.take(4)
    local ticks = range:le_uint() / 256
    tree:add(f.half_turn, range, ticks)
    if ticks > 0 then
        tree:add(f.clock, range, ticks * 120):set_generated()
    end
end

local function fix(walk, tree)
    walk.whole(tree, "time", 4)
    half_turn(walk, tree)
    local place = {}
    for k, name in ipairs({ "x", "y", "z" }) do
        place[k] = walk.fraction(tree, name, 4, 1 / 65536, true)
    end
    walk.fraction(tree, "mismatch", 2, 1 / 65536)
    walk.fraction(tree, "age", 2, 1 / 256)
    local flags = walk.take(1)
    tree:add(f.station_a, flags)
    tree:add(f.station_b, flags)
    tree:add(f.level, flags)
    for _, name in ipairs({ "vx", "vy", "vz" }) do
        walk.fraction(tree, name, 2, 1 / 1024, true)
    end
    for _, name in ipairs({ "sd_x", "sd_y", "sd_z" }) do
        walk.fraction(tree, name, 2, 1 / 65536)
    end
    for _, name in ipairs({ "edges", "pulses", "sweeps", "fixes", "reports" }) do
        walk.whole(tree, "lost_" .. name, 2)
    end
    return string.format("x %.3f, y %.3f, z %.3f m, %s", place[1], place[2], place[3],
        LEVELS[bit.rshift(flags:uint(), 4)] or "unknown level")
end

local function station(walk, tree, name)
    local sub = tree:add(lighthouse, walk.take(0), "Station " .. name:upper())
    walk.whole(sub, name .. "_id", 4)
    for _, what in ipairs({ "_good", "_bad", "_mode", "_faults" }) do
        walk.whole(sub, name .. what, 1)
    end
    -- 1/25,600 of a half turn of 1/120 s.
    walk.fraction(sub, name .. "_width_bias", 1, 1e6 / 120 / 25600, true)
    local flags = walk.take(1)
    sub:add(f[name .. "_factory"], flags)
    sub:add(f[name .. "_is_stranger"], flags)
end

local function health(walk, tree)
    local uptime = walk.whole(tree, "uptime", 4)
    half_turn(walk, tree)
    local lock = walk.whole(tree, "lock", 1)
    walk.whole(tree, "reset", 1)
    walk.whole(tree, "reset_detail", 4)
    for _, name in ipairs({ "syncs_a", "syncs_b", "sweeps_a_az", "sweeps_a_el", "sweeps_b_az", "sweeps_b_el" }) do
        walk.whole(tree, name, 2)
    end
    for _, reject in ipairs(REJECTS) do
        walk.whole(tree, "rejects_" .. reject[1], 2)
    end
    for _, name in ipairs({ "pulses", "sightings", "reports" }) do
        walk.whole(tree, "waiting_" .. name, 1)
    end
    station(walk, tree, "a")
    station(walk, tree, "b")
    return string.format("up %d s, %s", uptime, LOCKS[lock] or "unknown lock")
end

local function angles(walk, tree, count)
    half_turn(walk, tree)
    for n = 1, count do
        local sub = tree:add(f.sweep, walk.take(0))
        sub:append_text(" " .. n)
        walk.whole(sub, "sweep_time", 4)
        local rotor = walk.whole(sub, "sweep_rotor", 1)
        local range = walk.take(3)
        local share = range:le_uint() / 1048576
        sub:add(f.sweep_share, range, share)
        -- Half of a half turn is straight ahead.
        local degrees = (share - 0.5) * 180
        sub:add(f.sweep_angle, range, degrees):set_generated()
        sub:append_text(string.format(": %s, %.3f degrees", ROTORS[rotor] or "unknown rotor", degrees))
    end
    return count .. " sweeps"
end

-- The sweeps in an angles payload of `length` bytes; nothing where it is no such length.
local function sweeps(length)
    local count = (length - ANGLES_BEFORE) / ANGLE
    return count % 1 == 0 and count >= 1 and count <= ANGLES_MOST and count or nil
end

function lighthouse.dissector(buffer, pinfo, root)
    if buffer:len() < ENVELOPE or buffer(0, 2):string() ~= "LM" then
        return 0
    end
    pinfo.cols.protocol = "Lighthouse"
    local tree = root:add(lighthouse, buffer())
    tree:add(f.magic, buffer(0, 2))
    tree:add(f.version, buffer(2, 1))
    if buffer(2, 1):uint() ~= VERSION then
        tree:add_proto_expert_info(e_version)
        return buffer:len()
    end
    local kind = buffer(3, 1):uint()
    tree:add(f.kind, buffer(3, 1))
    tree:add_le(f.mote, buffer(4, 2))
    tree:add_le(f.sequence, buffer(6, 2))
    local from = source()
    if from and from.value ~= buffer(4, 2):le_uint() then
        tree:add_proto_expert_info(e_mote)
    end
    local walk, length, told = walker(buffer, ENVELOPE), buffer:len(), nil
    if kind == 1 and length == FIX then
        told = fix(walk, tree)
    elseif kind == 2 and length == HEALTH then
        told = health(walk, tree)
    elseif kind == 3 and sweeps(length) then
        told = angles(walk, tree, sweeps(length))
    elseif KINDS[kind] then
        tree:add_proto_expert_info(e_length)
    else
        tree:add_proto_expert_info(e_kind)
    end
    local title = string.format("mote 0x%04x #%d %s", buffer(4, 2):le_uint(), buffer(6, 2):le_uint(),
        KINDS[kind] or "unknown")
    pinfo.cols.info = told and title .. ": " .. told or title
    tree:append_text(", " .. title .. (told and ": " .. told or ""))
    return length
end

-- Whatever the PAN: our frames say who they are.
lighthouse:register_heuristic("wpan", function(buffer, pinfo, tree)
    if buffer:len() < ENVELOPE or buffer(0, 2):string() ~= "LM" then
        return false
    end
    lighthouse.dissector(buffer, pinfo, tree)
    return true
end)
